"""Kernels that exist for speed alone; what they compute, the others do too."""
