"""Minimisers, linear systems, sweeps and integrators, of which solvers are built."""
