"""A skirt on a walking figure: a stage with a skeleton, whose skinned legs and hips are deforming colliders.

The waist is pinned to the hips. docs/character_stage.py makes the stage; the animation is a layer over it.
"""

from dataclasses import replace
from pathlib import Path

import warpcloth as wc
from warpcloth.usd import read_scene


def scene(friction: float = 0.3, density: float = 0.2, stiffness: float = 300.0, bending: float = 2e-5, duration: float = 2.0):
    """Coefficient of friction, density [kg/m²], springs [N/m], plate bending stiffness [N·m], duration [s], up to 2."""
    read = read_scene(Path(__file__).with_name("character.usda"))
    values = {wc.Spring: stiffness, wc.QuadraticBending: bending}
    return replace(
        read,
        density=density,
        terms=[replace(term, stiffness=values[type(term)]) for term in read.terms],
        colliders=[replace(collider, friction=friction) for collider in read.colliders],
        duration=duration,
        name="character",
    )
