"""Measures of mesh sequences, comparison of two sequences, and intersections."""
