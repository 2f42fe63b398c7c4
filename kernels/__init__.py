"""Warp code: imports warp, numpy and itself, never the host package. Installed as warpcloth.kernels."""
