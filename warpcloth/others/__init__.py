"""Other simulators on scenes of warpcloth, to compare with. Each is an optional package."""
