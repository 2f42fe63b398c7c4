"""Cloth simulation: every classic method on the same scene, from energies written once."""
