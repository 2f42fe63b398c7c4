"""Checks, files, messages and locks that every other room needs."""
