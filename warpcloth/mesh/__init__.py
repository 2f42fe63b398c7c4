"""Meshes and sequences of them: built, selected from, ordered and loaded from files."""

from . import loading as loading  # enters its reader of files
