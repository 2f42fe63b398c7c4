"""Faster implementations of the core, with one entry, `plan`."""
