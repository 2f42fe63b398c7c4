"""Contact with colliders and of cloth with cloth: proximity, energies of pairs, sweeps and filters."""
