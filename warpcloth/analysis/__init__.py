"""Measures of sequences, and comparison of two."""
