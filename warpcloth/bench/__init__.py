"""Benchmarks: what a frame costs, what it must move at least, and how that grows with the scene."""
