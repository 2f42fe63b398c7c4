"""Other simulators, each an optional package, on scenes of warpcloth."""
