"""Runs of scenes: simulation, equilibrium, the watch over energy, and scene files."""
