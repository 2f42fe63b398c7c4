"""Kernels that exist for speed alone; the others compute the same."""
