"""A mesh from a stage: the square cloth among Warp's example assets, pinned at the two corners of a long side.

According to the file it is 150 m by 100 m, with z up; it starts level. The animation is a layer over the file.
"""

import os

import warp.examples

import warpcloth as wc
from warpcloth.usd import read_stage_mesh


def scene(density: float = 0.5, stiffness: float = 1e6, bending: float = 1.0, duration: float = 1.0):
    """Density [kg/m²], stiffness of a spring on each edge [N/m], plate bending stiffness [N·m], duration [s]."""
    stage = read_stage_mesh(os.path.join(warp.examples.get_asset_directory(), "square_cloth.usd"))
    return wc.Scene(
        stage.mesh,
        density=density,
        terms=[
            wc.Spring(pairs="edges", stiffness=stiffness),
            wc.QuadraticBending(stiffness=bending),
        ],
        pins=stage.mesh.corners()[:2],
        duration=duration,
        fps=stage.time_codes_per_second,
        name="usd_cloth",
        stage=stage,
    )
