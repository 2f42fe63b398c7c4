"""Meshes and sequences of them: built, selected from, ordered and loaded from files."""
