"""Operators, state and capture that all solvers share."""
