"""Checks, output files, messages and locks that all other packages use."""
