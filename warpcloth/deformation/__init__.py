"""As-rigid-as-possible deformation."""
