"""Cells of maps of stability: applies values of axes to a scene and a solver."""

import math
from dataclasses import fields, replace

import numpy as np

from ..base.checks import number
from ..run.scene_files import find_source
from .axes import FIXED, OPTIONS, SEED, VARIED
from .measurements import Setup

# Approximate number of frames to compare; the steps per frame follow from it.
FRAMES = 64
# Noise of the initial positions, relative to the median edge, from which instabilities grow, a hundredfold in energy while
# springs are linear.
NOISE = 1e-6
# Names of parameters of scenes that set their resolution.
_RESOLUTIONS = ("n", "links", "elements")


def scene_at(ref, values, steps, duration=None):
    """Returns the scene of a cell, with frames of one step or more and noise in the initial positions.

    It has at least ``steps``, rounded up to whole frames, or lasts a ``duration`` [s] with about :data:`FRAMES` frames. ``dt``
    is among the values by axis.

    Raises:
        ValueError: The scene cannot have such a value.
    """
    number("dt", values["dt"], above=0.0)
    if "resolution" in values:
        ref = refined(ref, values["resolution"])
    scene = ref.load()
    if scene.pins.keyframes is not None:
        raise ValueError(
            f"{scene.name}: its pins move, frame by frame; a map needs pins at rest, for it changes the frame rate"
        )
    for collider in (each for each in scene.colliders if each.moves):
        rule = "a map needs colliders at rest, for it changes the frame rate"
        raise ValueError(f"{scene.name}: the collider {collider.label} moves, frame by frame; {rule}")
    for name in VARIED:
        if name in values:
            scene = applied(scene, name, values[name])
    compared = steps if duration is None else steps_in(duration, values["dt"])
    each = -(-compared // FRAMES)
    frame, frames = each * values["dt"], -(-max(steps, compared) // each)
    noise = np.random.default_rng(SEED).normal(size=scene.positions.shape)
    noise *= NOISE * np.median(scene.mesh.edge_lengths)
    noise[scene.pins.vertices] = 0.0
    return replace(scene, positions=scene.positions + noise, fps=1.0 / frame, duration=frames * frame)


def steps_in(duration, dt):
    return max(math.ceil(duration / dt * (1.0 - 1e-9)), 1)


def refined(ref, value):
    """Returns the :class:`SceneRef` with another resolution.

    Raises:
        ValueError: The scene has no parameter for the resolution.
    """

    known = find_source(ref.name).parameters
    for name in _RESOLUTIONS:
        if name in known:
            return replace(ref, parameters={**ref.parameters, name: int(value)})
    raise ValueError(f"{ref.name} has no resolution to vary; none of its parameters is {' or '.join(_RESOLUTIONS)}")


def applied(scene, name, value):
    if name == "stiffness":
        return replace(scene, terms=[replace(term, stiffness=value * np.asarray(term.stiffness)) for term in scene.terms])
    if name == "compression":
        # About the middle of the pins, so that a hanging cloth stays at its pins.
        held = scene.positions[scene.pins.vertices] if len(scene.pins.vertices) else scene.positions
        middle = held.mean(axis=0)
        return replace(scene, positions=middle + (1.0 - value) * (scene.positions - middle))
    masses = scene.vertex_masses.copy()
    masses[_furthest(scene)] *= value
    return replace(scene, density=None, masses=masses)


def vary(scene, name, values):
    """Returns the ``vary`` of a model whose copies differ in one of :data:`VARIED`."""
    each = [applied(scene, name, value) for value in values]
    if name == "stiffness":
        stiffness = [[np.asarray(term.stiffness) for term in one.terms] for one in each]
        return {
            f"{term.label}.stiffness": np.array(column)
            for term, column in zip(scene.terms, zip(*stiffness, strict=True), strict=True)
        }
    if name == "compression":
        return {"positions": np.array([one.positions for one in each])}
    return {"masses": np.array([one.vertex_masses for one in each])}


def together(scene, name):
    """Returns whether copies of one model can differ in it; ``vary`` cannot tell apart terms of one name."""
    labels = [term.label for term in scene.terms]
    return name in VARIED and (name != "stiffness" or len(set(labels)) == len(labels))


def record_at(setup, values):
    """Returns the record of the solver of a cell.

    Raises:
        ValueError: The solver has no such option, or a value is not allowed.
    """
    record = Setup(setup.solver, {**setup.options, "dt": values.get("dt", FIXED["dt"])}).record()
    known = {field.name for field in fields(record)}
    for name in OPTIONS:
        if name in values:
            if name not in known:
                raise ValueError(f"{setup.solver} has no {name}")
            record = replace(record, **{name: values[name]})
    return record.without_limits()


def _furthest(scene):
    points = scene.mesh.points
    pins = points[scene.pins.vertices] if len(scene.pins.vertices) else points.mean(axis=0)[None]
    return int(np.linalg.norm(points[:, None] - pins, axis=-1).min(axis=1).argmax())
