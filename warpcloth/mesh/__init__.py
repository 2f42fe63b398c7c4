"""Meshes and mesh sequences: construction, vertex selections, vertex order and files."""

from . import loading as loading  # registers its reader of files
