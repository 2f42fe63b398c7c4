"""Minimisers, linear systems, sweeps and integrators that solvers are made of."""
