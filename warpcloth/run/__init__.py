"""Runs of scenes: simulation, equilibrium, detection of divergence, and scene files."""
