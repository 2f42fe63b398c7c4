"""Measuring: reference solutions, work and precision, stability, failures, benchmarks."""
