"""Tests of scenes and the models built from them: refusals, copies that differ, and nothing that is not declared."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import warp as wp

import warpcloth as wc
from support.energies import DECLARED, energy_and_gradient
from support.rows import slow_but
from warpcloth.base.kernel_cache import HEADERS
from warpcloth.core import sums as of_copies
from warpcloth.core.capture import Mirror
from warpcloth.core.gradient import Gradient
from warpcloth.core.sums import RowSums, Sums
from warpcloth.model.elements import incidences_of
from warpcloth.model.host_values import host_values
from warpcloth.model.precision import DTYPES
from warpcloth.solvers import SOLVERS
from warpcloth.terms import TERMS as KINDS

# 35 vertices, 82 edges, 48 triangles, 62 hinges, 4 corners: all counts differ.
MESH = wc.Mesh.grid(7, 5, pattern="alternating")
VERTICES, EDGES, HINGES, ATTACHED = 35, 82, 62, 33


def scene(**fields):
    """A sheet of springs, with other fields."""
    given = {"mesh": MESH, "density": 0.1, "terms": [wc.Spring(stiffness=100.0)], **fields}
    return wc.Scene(**given)


def frames_at(positions):
    return np.asarray(positions, dtype=float).reshape(1, -1, 3)


def moved(end):
    """Vertex 0 pinned, and moved there."""
    return wc.Pins([0], np.stack([frames_at(MESH.points[0])[0], [end]]))


def without(values, index, bad):
    changed = np.array(values, dtype=float)
    changed[index] = bad
    return changed


def masses(vertex=0, bad=1.0, **more):
    """Fields of masses of 1 kg, but for one vertex."""
    return {"density": None, "masses": without(np.ones(VERTICES), vertex, bad)} | more


def varied(name, *values):
    """Options of a build of a copy for each value."""
    return {"copies": len(values), "vary": {name: [*values]}}


# --- scenes that are refused: fields, part of the message

BAD_SCENES = {
    "no mass": ({"density": None}, "exactly one of density and masses"),
    "two masses": ({"masses": np.ones(VERTICES)}, "exactly one of density and masses"),
    "negative density": ({"density": -1.0}, "density is -1.0"),
    "density NaN": ({"density": np.nan}, "density is nan"),
    "masses of another mesh": ({"density": None, "masses": np.ones(3)}, "masses has shape (3,)"),
    "massless vertex": (masses(9, 0.0), "vertex 9 has mass 0.0 kg"),
    "isolated vertex": ({"mesh": wc.Mesh([*np.eye(3), [5, 5, 5]], [[0, 1, 2]])}, "vertex 3 has mass 0.0 kg"),
    "positions of another mesh": ({"positions": np.zeros((3, 3))}, "positions has shape (3, 3)"),
    "position NaN": ({"positions": without(MESH.points, (4, 1), np.nan)}, "positions[4, 1] is nan"),
    "velocity infinite": ({"velocities": without(0 * MESH.points, (4, 1), np.inf)}, "velocities[4, 1] is inf"),
    "gravity a number": ({"gravity": -9.81}, "gravity has shape ()"),
    "gravity a word": ({"gravity": "down"}, "gravity is 'down', which is not numeric"),
    "pin outside": ({"pins": [0, 35]}, "pins.vertices[1] is 35; it must lie in 0 … 34"),
    "pin negative": ({"pins": [-1]}, "pins.vertices[0] is -1"),
    "pin twice": ({"pins": [3, 4, 3]}, "names vertex 3 twice"),
    "pin a fraction": ({"pins": [0.5]}, "pins.vertices has shape (1,) and type float64"),
    "pin mask": ({"pins": np.ones(VERTICES, dtype=bool)}, "pins.vertices has shape (35,) and type bool"),
    "pins one number": ({"pins": 5}, "pins.vertices has shape ()"),
    "pins in columns": ({"pins": [[0, 1]]}, "pins.vertices has shape (1, 2)"),
    "pins ragged": ({"pins": [[0], [1, 2]]}, "pins.vertices is [[0], [1, 2]]; it must be a list"),
    "pins unreadable": ({"pins": "x <"}, "column"),
    "keyframes too few": ({"pins": wc.Pins([0, 1], frames_at(MESH.points[0]))}, "pins.keyframes has shape (1, 1, 3)"),
    "keyframes flat": ({"pins": wc.Pins([0], MESH.points[:1])}, "pins.keyframes has shape (1, 3)"),
    "keyframes empty": ({"pins": wc.Pins([0], np.zeros((0, 1, 3)))}, "pins.keyframes has no frame; it must have one or more"),
    "keyframes elsewhere": ({"pins": wc.Pins([0], frames_at([0.0, 1.0, 0.0]))}, "1 m from where the pinned vertices start"),
    "keyframe NaN": ({"pins": wc.Pins([0], frames_at([0.0, np.nan, 0.0]))}, "pins.keyframes[0, 0, 1] is nan"),
    "no time": ({"duration": 0.0}, "duration is 0.0; it must be a number above 0"),
    "part of a frame": ({"duration": 0.51, "fps": 30.0}, "whole number of frames"),
    "forever": ({"duration": np.inf}, "duration is inf; it must be a number above 0"),
    "no frame rate": ({"fps": 0.0}, "fps is 0.0"),
    "frame rate NaN": ({"fps": np.nan}, "fps is nan"),
    "frame rate a text": ({"fps": "60"}, "fps is '60'; it must be a number"),
    "frame rate a truth": ({"fps": True}, "fps is True; it must be a number"),
    "duration a text": ({"duration": "1"}, "duration is '1'; it must be a number"),
    "duration None": ({"duration": None}, "duration is None; it must be a number"),
    "too long to count": ({"duration": 1e300}, "duration is 1e+300 s; at fps 60.0 it must be a whole number of frames from 1"),
    "no term": ({"terms": [100.0]}, "terms[0] is 100.0"),
    "a class of terms": ({"terms": [wc.Spring]}, "terms[0] is the class Spring; it must be an energy"),
    "a term alone": ({"terms": wc.Spring(stiffness=1.0)}, "terms is one Spring on its own; it must be a list"),
    "terms None": ({"terms": None}, "terms is None; it must be a list"),
    "elements of a term": ({"terms": [wc.Spring(stiffness=1).elements(wc.Mesh.chain(3), None)]}, "terms[0] is Elements("),
    "mesh a word": ({"mesh": "x"}, "mesh is 'x'; it must be a Mesh"),
    "density a word": ({"density": "a"}, "density is 'a'; it must be a number above 0"),
    "density a truth": ({"density": True}, "density is True; it must be a number above 0"),
    "density above all numbers": ({"density": 10**400}, "density is 1000000"),
    "density of each": ({"density": np.ones(16)}, "density is array([1., 1.,"),
    "density too large to multiply": ({"density": 1e308, "mesh": wc.Mesh.grid(2, 2, size=1e5)}, "vertex 0 has mass inf kg"),
    "masses a word": ({"density": None, "masses": "a"}, "masses is 'a', which is not numeric"),
    "negative mass of a pin": (masses(9, -1.0, pins=[9]), "masses[9] is -1.0; it must be 0 or more"),
}


def attached(**fields):
    return lambda: wc.Attachment(stiffness=1.0, **fields)


def stvk(**fields):
    return lambda: wc.StVKMembrane(stiffness=1.0, **fields)


# Terms that a scene may hold but that do not fit its mesh, and builds that do not fit the scene: part of the message.
BAD_TERMS = {
    "negative": (lambda: wc.Spring(stiffness=-1.0), "Spring.stiffness is -1.0; it must be 0 or more"),
    "NaN": (lambda: wc.Spring(stiffness=np.nan, name="warp"), "warp.stiffness is nan"),
    "a word": (lambda: wc.Spring(stiffness="stiff"), "Spring.stiffness is 'stiff', which is not numeric"),
    "one of many": (lambda: wc.Spring(stiffness=without(np.ones(EDGES), 5, -2.0)), "Spring.stiffness[5] is -2.0"),
    "too few": (lambda: wc.Spring(stiffness=[1.0, 2.0]), "Spring.stiffness has shape (2,)"),
    "unknown pairs": (lambda: wc.Spring(stiffness=1.0, pairs="diagonal"), "'diagonal'"),
    "no pairs": (lambda: wc.Spring(stiffness=1.0, pairs=[]), "Spring.pairs has shape (0,)"),
    "pair of one": (lambda: wc.Spring(stiffness=1.0, pairs=[[0, 1], [2, 2]]), "Spring.pairs[1] is [2, 2]"),
    "pair outside": (lambda: wc.Spring(stiffness=1.0, pairs=[[0, 35]]), "Spring.pairs[0] is [0, 35]"),
    "negative length": (lambda: wc.Spring(stiffness=1.0, rest_lengths=-1.0), "Spring.rest_lengths is -1.0"),
    "too few lengths": (lambda: wc.Spring(stiffness=1.0, rest_lengths=[1.0, 2.0]), "Spring.rest_lengths has shape (2,)"),
    "nothing attached": (attached(), "Attachment.vertices has shape (0, 1)"),
    "attached outside": (attached(vertices=[0, 40]), "Attachment.vertices[1] is [40]"),
    "targets": (attached(vertices=[0], targets=[[0, 0]]), "Attachment.targets has shape (1, 2)"),
    "target NaN": (attached(vertices=[0], targets=[[0, 0, np.nan]]), "Attachment.targets[0, 2] is nan; it must be finite"),
    "target a word": (attached(vertices=[0], targets="a"), "Attachment.targets is 'a'"),
    "attached None": (attached(vertices=None), "Attachment.vertices is None"),
    "pairs None": (lambda: wc.Spring(stiffness=1.0, pairs=None), "Spring.pairs is None; it must hold integers"),
    "pairs ragged": (lambda: wc.Spring(stiffness=1.0, pairs=[[0, 1], [2]]), "Spring.pairs is [[0, 1], [2]]"),
    "length a word": (lambda: wc.Spring(stiffness=1.0, rest_lengths="a"), "Spring.rest_lengths is 'a'"),
    "length infinite": (lambda: wc.Spring(stiffness=1.0, rest_lengths=[1.0, np.inf]), "Spring.rest_lengths[1] is inf"),
    "stiffness None": (lambda: wc.Spring(stiffness=None), "Spring.stiffness is None, which is not numeric"),
    "stiffness a truth": (lambda: wc.Spring(stiffness=True), "Spring.stiffness is True, which is not numeric"),
    "ratio of 1": (stvk(poisson_ratio=1.0), "StVKMembrane.poisson_ratio is 1.0; it must be above"),
    "ratio of -1": (
        lambda: wc.NeoHookeanMembrane(stiffness=1.0, poisson_ratio=-1.0),
        "poisson_ratio is -1.0; it must be above",
    ),
    "ratio NaN": (lambda: wc.NeoHookeanMembrane(stiffness=1.0, poisson_ratio=np.nan), "poisson_ratio is nan"),
    "too few ratios": (stvk(poisson_ratio=[0.1, 0.2]), "StVKMembrane.poisson_ratio has shape (2,)"),
    "too few triangles": (lambda: wc.CorotatedMembrane(stiffness=[1.0, 2.0]), "CorotatedMembrane.stiffness has shape (2,)"),
    "modulus below 0": (lambda: wc.CorotatedMembrane.from_material(-1.0, 1e-3), "CorotatedMembrane.youngs_modulus is -1.0"),
    "thickness 0": (lambda: wc.StVKMembrane.from_material(1e6, 0.3, 0.0), "StVKMembrane.thickness is 0.0; it must be above 0"),
    "mu 0": (lambda: wc.StVKMembrane.from_moduli(0.0, 1.0), "StVKMembrane.mu is 0.0; it must be above 0"),
    "lam too low": (lambda: wc.StVKMembrane.from_moduli(1.0, -1.0), "StVKMembrane.poisson_ratio is -1.0"),
    "no limit": (lambda: wc.StrainLimit(), "StrainLimit has neither least nor most"),
    "least 0": (lambda: wc.SpringLimit(least=0.0), "SpringLimit.least is 0.0; it must be finite, above 0"),
    "most infinite": (lambda: wc.StrainLimit(least=0.9, most=np.inf), "StrainLimit.most is inf; it must be finite, above 0"),
    "least above most": (lambda: wc.StrainLimit(least=1.1, most=1.0), "StrainLimit.least is 1.1; it must be no more than most"),
    "too few limits": (lambda: wc.SpringLimit(most=[1.0, 1.1]), "SpringLimit.most has shape (2,)"),
    "name a number": (lambda: wc.Spring(stiffness=1.0, name=5), "Spring.name is 5"),
}


@pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)
@pytest.mark.parametrize("stiffness", [-1.0, np.nan, [1.0, -1.0], "stiff"])
def test_what_needs_no_mesh_is_refused_when_written(kind, stiffness):
    with pytest.raises(ValueError, match=rf"^{kind.__name__}.stiffness(\[1\])? is "):
        kind(stiffness=stiffness)


@pytest.mark.parametrize(
    "term", [wc.QuadraticBending(stiffness=1.0), wc.DihedralBending(stiffness=1.0), wc.StrainLimit(most=1.0)]
)
def test_a_term_without_elements_is_refused(term):
    with pytest.raises(ValueError, match="has no elements"):
        wc.Scene(wc.Mesh.chain(5), density=0.1, terms=[term]).build()


BAD_BUILDS = {
    "dtype": ({"dtype": "float16"}, "dtype is 'float16'"),
    "device": ({"device": "tpu"}, "tpu"),
    "no copies": ({"copies": 0}, "copies is 0"),
    "half a copy": ({"copies": 1.5}, "copies is 1.5"),
    "unknown": ({"vary": {"wind": [1.0]}}, "vary['wind'] names nothing in this scene"),
    "time": (varied("duration", 1.0, 2.0), "vary['duration'] is the same for all copies, which share their time"),
    "term that is not there": ({"vary": {"DihedralBending.stiffness": [1.0]}}, "names nothing in this scene"),
    "parameter that is not there": ({"vary": {"Spring.colour": [1.0]}}, "names nothing in this scene"),
    "rest length below 0": (varied("Spring.rest_lengths", 1.0, -1.0), "rest_lengths is -1.0 in copy 1; it"),
    "gravity of one": ({"copies": 2, "vary": {"gravity": [[0, 0, 0]]}}, "vary['gravity'] has shape (1, 3)"),
    "gravity NaN": ({"vary": {"gravity": [[0, np.nan, 0]]}}, "vary['gravity'][0, 1] is nan; it must be finite"),
    "density of three": ({"copies": 2, "vary": {"density": [1.0, 1.0, 1.0]}}, "vary['density'] has shape (3,)"),
    "density below 0": (varied("density", 1.0, -1.0), "vary['density'] is -1.0 in copy 1; it must be above 0"),
    "stiffness of three": ({"copies": 2, "vary": {"Spring.stiffness": [1.0] * 3}}, "vary['Spring.stiffness'] has shape (3,)"),
    "stiffness below 0": (varied("Spring.stiffness", 1.0, -1.0), "Spring.stiffness is -1.0 in copy 1"),
    "stiffness NaN": (varied("Spring.stiffness", 1.0, np.nan), "Spring.stiffness is nan in copy 1"),
    "positions of one": ({"copies": 2, "vary": {"positions": MESH.points}}, "vary['positions'] has shape (35, 3)"),
    "copies a truth": ({"copies": True}, "copies is True; it must be a whole number"),
    "dtype in a list": ({"dtype": [1]}, "dtype is [1]; it must be one of 'float32', 'float64'"),
    "vary a list": ({"vary": [1]}, "vary is [1]; it must be a dict"),
    "vary a number for a name": ({"vary": {1: 2, "wind": 3}}, "vary[1] names nothing in this scene"),
    "gravity a word": ({"vary": {"gravity": "abc"}}, "vary['gravity'] is 'abc', which is not numeric"),
    "stiffness of words": ({"copies": 2, "vary": {"Spring.stiffness": ["a", "b"]}}, "vary['Spring.stiffness'] is ['a', 'b']"),
    "density and masses": (
        {"vary": {"density": [1.0], "masses": np.ones((1, VERTICES))}},
        "vary has density and masses; at most one of the two",
    ),
    "mass below 0": (
        varied("masses", *without(np.ones((2, 35)), (1, 7), -2.0)),
        "vary['masses'] of vertex 7 is -2.0 kg in copy 1",
    ),
}


# Scenes and copies of them that do not go together.
MOVED = moved([0, 1, 0])
BAD_PAIRS = {
    "density of masses": (
        masses(),
        {"vary": {"density": [1.0]}},
        "vary['density'] needs a scene with a density, and this one has masses; vary['masses'] instead",
    ),
    "pins that start elsewhere": (
        {"pins": MOVED},
        {"copies": 2, "vary": {"positions": [MESH.points, MESH.points + np.array([0, 0, 2.0])]}},
        "pins.keyframes[0] is 2 m from where the pinned vertices start in copy 1; it must be there",
    ),
    "a name and its class": (
        {"terms": [wc.Spring(stiffness=1.0, name="warp")]},
        {"vary": {"warp.stiffness": [1.0], "Spring.stiffness": [2.0]}},
        "vary['Spring.stiffness'] changes nothing: every Spring has an entry under its own name; leave it out",
    ),
    "a limit that is none": (
        {"terms": [wc.SpringLimit(most=1.1)]},
        {"copies": 2, "vary": {"SpringLimit.least": [1.0, 1.2]}},
        "SpringLimit.least is 1.2; it must be no more than most, in copy 1",
    ),
}


BAD = [(f"scene, {name}", lambda fields=fields: scene(**fields), message) for name, (fields, message) in BAD_SCENES.items()]
BAD += [
    (f"term, {name}", lambda term=term: scene(terms=[term()]).build(), message) for name, (term, message) in BAD_TERMS.items()
]
BAD_PAIRS |= {f"build, {name}": ({}, build, message) for name, (build, message) in BAD_BUILDS.items()}
BAD += [(name, lambda given=given: scene(**given[0]).build(**given[1]), given[2]) for name, given in BAD_PAIRS.items()]


@pytest.mark.parametrize(("attempt", "message"), [row[1:] for row in BAD], ids=[row[0] for row in BAD])
def test_what_is_refused(attempt, message):
    with pytest.raises(ValueError) as error:
        attempt()
    assert message in str(error.value) and "\n" not in str(error.value)


# Good scenes that float32 cannot hold: fields, build, part of the message. float64 holds them.
HERE = "float32 ends at 3.4e+38, and towards 0 at 1.2e-38; use other units or use float64"
SMALL = wc.Mesh.grid(4, 4, size=1e-22)


def away(distance):
    """The sheet, that far along x."""
    return {"positions": MESH.points + np.array([distance, 0, 0])}


FAR = (
    "vertex 6 is at x = 100001 m, where float32 resolves 0.012 m, and the median edge is 0.25 m, which must be 100 times that; "
)
FAR += "move it to the origin or use float64"
LOST = {
    "stiffness": ({"terms": [wc.Spring(stiffness=1e39)]}, {}, f"Spring.stiffness is 1e+39; {HERE}"),
    "no stiffness left": ({"terms": [wc.Spring(stiffness=1e-60)]}, {}, f"Spring.stiffness is 1e-60; {HERE}"),
    "stiffness of an element": (
        {"terms": [wc.Spring(stiffness=without(np.full(EDGES, np.inf), 3, 1e39))]},
        {},
        "Spring.stiffness of element 3 is 1e+39",
    ),
    "stiffness of a copy": ({}, varied("Spring.stiffness", 1.0, 1e39), "Spring.stiffness of copy 1 is 1e+39"),
    "rest length": ({"terms": [wc.Spring(stiffness=1.0, rest_lengths=1e39)]}, {}, "Spring: rest state of element 0 is 1e+39"),
    "mass": ({"density": 1e42}, {}, "mass of vertex 0 is "),
    "small mass": (masses(3, 1e-42), {}, f"mass of vertex 3 is 1e-42 kg; {HERE}"),
    "inverse mass": (masses(3, 2e-39), {}, "mass of vertex 3 is 2e-39 kg"),
    "mass of a copy": ({}, varied("density", 1.0, 1e42), "mass of vertex 0 of copy 1 is "),
    "small cloth": ({"mesh": SMALL}, {}, "an edge of the mesh is 3.33e-23 m long"),
    "large cloth": ({"mesh": wc.Mesh.grid(4, 4, size=1e20)}, {}, "an edge of the mesh is 3.33e+19 m long"),
    "velocity": ({"velocities": without(0 * MESH.points, (4, 1), 1e39)}, {}, "velocity of vertex 4 is 1e+39 m/s"),
    "gravity": ({"gravity": [0, -1e39, 0]}, {}, "gravity is -1e+39 m/s²"),
    "far away": (away(1e5), {}, FAR),
    "a copy far away": (
        {},
        varied("positions", MESH.points, MESH.points - [0, 1e5, 0]),
        "vertex 0 of copy 1 is at y = -100000 m",
    ),
    "a pin that goes far away": ({"pins": moved([0, 0, 1e5])}, {}, "keyframe 1 of pinned vertex 0 is at z = 100000 m"),
}


@pytest.mark.parametrize(("fields", "build", "message"), LOST.values(), ids=LOST)
@pytest.mark.filterwarnings("error")
def test_what_float32_loses_is_refused(fields, build, message):
    with pytest.raises(ValueError) as error:
        scene(**fields).build(**build)
    assert message in str(error.value) and "use float64" in str(error.value)
    scene(**fields).build(dtype="float64", **build)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (masses(3, 1e-310), "mass of vertex 3 is 1e-310 kg"),
        (away(1e14), "where float64 resolves 0.022 m"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_what_float64_loses_is_refused_without_advising_it(fields, message):
    with pytest.raises(ValueError) as error:
        scene(**fields).build(dtype="float64")
    assert message in str(error.value) and "use float64" not in str(error.value)


def test_what_is_near_a_limit_is_built():
    for fields in (away(1e4), {"terms": [wc.Spring(stiffness=np.inf)]}, {"terms": [wc.Spring(stiffness=0.0)]}):
        scene(**fields).build()
    model = scene(**masses(3, 0.0, pins=[3])).build()  # a pinned vertex needs no mass
    assert model.inverse_mass.numpy()[3] == 0.0 and np.isfinite(model.inverse_mass.numpy()).all()


@pytest.mark.parametrize("solver", [record(substeps=1) for record in SOLVERS.values()], ids=SOLVERS)
@pytest.mark.parametrize(("given", "shown"), [(scene(), "a Scene"), (None, "None"), (3, "3")])
def test_a_solver_binds_a_model(solver, given, shown):
    with pytest.raises(ValueError, match=rf"^model is {shown}; bind takes a model, which scene.build\(\) makes$"):
        solver.bind(given)


# --- what a scene holds

PINS = {
    "none": (None, []),
    "indices": ([7, 2], [7, 2]),
    "array": (np.array([3], dtype=np.uint8), [3]),
    "selection": ("corners", [0, 6, 28, 34]),
    "record": (wc.Pins("z == 0 and x > 0.9"), [6]),
    "moved": (MOVED, [0]),
}


@pytest.mark.parametrize(("pins", "vertices"), PINS.values(), ids=PINS)
def test_pins(pins, vertices, device):
    made = scene(pins=pins)
    assert made.pins.vertices.tolist() == vertices and made.pins.vertices.dtype == np.int32
    model = made.build(device=device, dtype="float64", copies=2)
    held = np.flatnonzero(model.inverse_mass.numpy().reshape(2, -1) == 0.0)
    assert held.tolist() == sorted([*vertices, *(VERTICES + np.array(vertices, dtype=int))])
    assert (model.mass.numpy() > 0.0).all()
    moved = isinstance(pins, wc.Pins) and pins.keyframes is not None
    assert (model.pins is not None) == (model.keyframes is not None) == moved


@pytest.mark.parametrize("copies", [None, 2])
@pytest.mark.parametrize("pins", [[3, 9], MOVED], ids=["fixed", "moved"])
def test_a_pinned_vertex_starts_at_rest(pins, copies, device):
    """A pinned vertex has velocity 0, whatever the scene says: otherwise every frame would show it for a vertex at rest."""
    velocities = np.ones((VERTICES, 3))
    vary = {"velocities": np.tile(velocities, (copies, 1, 1))} if copies else None
    made = scene(pins=pins, velocities=velocities)
    model = made.build(device=device, copies=copies or 1, vary=vary)
    still = (model.velocities.numpy().reshape(-1, VERTICES, 3) == 0.0).all(axis=2)
    assert all(np.flatnonzero(copy).tolist() == made.pins.vertices.tolist() for copy in still)
    assert (made.velocities == 1.0).all()


# Fields of a scene; what is replaced in it.
REPLACED = {
    "terms of a density": ({}, {"terms": ()}),
    "positions of the mesh": ({"positions": MESH.points}, {"fps": 30.0}),
    "density": ({}, {"density": 0.2}),
    "density by masses": ({}, masses()),
    "masses": (masses(), {"name": "other"}),
    "pins that move": ({"pins": MOVED, "velocities": np.ones((VERTICES, 3))}, {"gravity": (0.0, 0.0, 0.0)}),
}


@pytest.mark.parametrize(("fields", "changes"), REPLACED.values(), ids=REPLACED)
def test_fields_of_a_scene_can_be_replaced(fields, changes):
    made = scene(**fields)
    assert (made.masses is None) == (made.density is not None)
    assert made.vertex_masses.shape == (VERTICES,)
    changed, expected = replace(made, **changes), scene(**{**fields, **changes})
    for field in ("positions", "velocities", "vertex_masses", "gravity"):
        assert (getattr(changed, field) == getattr(expected, field)).all()
    assert changed.pins.vertices.tolist() == expected.pins.vertices.tolist()
    assert (changed.pins.keyframes is None) == (expected.pins.keyframes is None)
    assert changed.terms == changes.get("terms", made.terms)
    for field in ("density", "fps", "name", "frames"):
        assert getattr(changed, field) == getattr(expected, field)
    assert (changed.masses is None) == (expected.masses is None)


OVERLAPPING = {
    "structural springs are edges": ("edges", "structural"),
    "one kind twice": ("edges", "edges"),
    "half of the shear springs are edges": ["shear", "edges"],
}


@pytest.mark.parametrize("kinds", OVERLAPPING.values(), ids=OVERLAPPING)
def test_a_pair_of_several_kinds_is_one_spring(kinds):
    pairs = wc.Spring(stiffness=1.0, pairs=kinds).stencil(MESH)
    one_by_one = [MESH.springs(kind).tolist() for kind in kinds]
    assert pairs.dtype == np.int32
    assert pairs.tolist() == [list(pair) for pair in sorted({tuple(pair) for pairs in one_by_one for pair in pairs})]
    assert len(pairs) < sum(map(len, one_by_one))


@pytest.mark.parametrize("pairs", ["edges", "structural", ("edges",), None], ids=str)
@pytest.mark.parametrize("order", [None, [3, 1, 0, 2]])
def test_arrays_follow_the_edges_as_given(pairs, order, device):
    """Of springs and limits, and of a model in an order of its own."""
    edges, k = [[3, 2], [1, 2], [0, 1]], np.array([1.0, 10.0, 100.0])
    pairs = np.array(edges) if pairs is None else pairs
    terms = [
        wc.Spring(pairs=pairs, stiffness=k, rest_lengths=2.0 * k, damping=3.0 * k),
        wc.SpringLimit(pairs=pairs, stiffness=4.0 * k, least=1e-3 * k, most=5.0 * k),
    ]
    made = wc.Scene(wc.Mesh(np.diag([1.0, 2, 3, 4])[:, :3], edges=edges), masses=np.ones(4), terms=terms)
    model = made.build(device=device, dtype="float64", order=order)
    named = np.arange(4) if order is None else np.array(order)
    scale = dict(zip(((2, 3), (1, 2), (0, 1)), k, strict=True))
    for elements, factors in zip(model.terms, ((1.0, 2.0, 3.0), (4.0, 1e-3, 5.0)), strict=True):
        own = [scale[tuple(sorted(named[pair].tolist()))] for pair in elements.stencil.numpy()]
        lengths = np.linalg.norm(np.diff(made.mesh.points[named[elements.stencil.numpy()]], axis=1)[:, 0], axis=1)
        found = [elements.stiffness.numpy(), *elements.rest.numpy().T]
        if elements.damping is not None:
            found.append(elements.damping.numpy())
        else:
            found[1:] = [found[1] / lengths, found[2] / lengths]
        assert np.allclose(found, np.outer(factors, own), rtol=1e-14), elements.label


def test_lumped_mass():
    sheet, chain = scene(), wc.Scene(wc.Mesh.chain(5, length=2.0), density=0.1)
    assert np.isclose(sheet.vertex_masses.sum(), 0.1, rtol=1e-14)
    assert (sheet.vertex_masses == 0.1 * MESH.vertex_areas).all()
    assert np.allclose(chain.vertex_masses, 0.1 * 2.0 / 4 * np.array([0.5, 1, 1, 1, 0.5]), rtol=1e-14)


def test_a_scene_prints_itself():
    lengths = np.full(EDGES, 0.1)
    given = {"terms": [wc.Spring(stiffness=100.0, rest_lengths=lengths, name="warp"), wc.DihedralBending(stiffness=1e-4)]}
    given |= {"pins": [0, 6], "duration": 0.5, "name": "curtain"}
    made = scene(**given)
    text = str(made)
    parts = ("curtain", "35 vertices", "48 triangles", "82 edges", "mass 0.1 kg", "30 frames", "pins: 2")
    spring = "Spring(stiffness=100.0, name='warp', pairs='edges', rest_lengths=array(82,))"
    for part in (*parts, spring, "DihedralBending(stiffness=0.0001)"):
        assert part in text
    assert made.frames == 30 and len(text.splitlines()) < 10


# --- the report


def all_terms(spring=100.0, bend=1e-3, hold=10.0):
    hinges = [wc.QuadraticBending(stiffness=1e-3), wc.DihedralBending(stiffness=bend, name="bend")]
    return [wc.Spring(stiffness=spring), *hinges, wc.Attachment(vertices="corners", stiffness=hold)]


TERMS = {
    "none": [],
    "one value": [wc.Spring(stiffness=100.0)],
    "all": [replace(term, name=None) for term in all_terms()],
    "hard": [wc.Spring(stiffness=np.inf)],
    "of each element": [wc.Spring(stiffness=np.linspace(1.0, 2.0, EDGES))],
}


@pytest.mark.parametrize("terms", TERMS.values(), ids=TERMS)
@pytest.mark.parametrize("dtype", slow_but(["float32"], DTYPES))
@pytest.mark.parametrize("copies", [1, 3])
@pytest.mark.filterwarnings("error")
def test_report_counts_what_was_built(terms, dtype, copies, device):
    """The bytes are those that Warp's own tracker saw, and those that the arrays should have."""
    keyframes = np.tile(MESH.points[:1], (4, 1, 1))
    made = scene(terms=terms, pins=wc.Pins([0], keyframes))
    with wp.ScopedMemoryTracker("build", print=False) as tracker:
        tracker.clear()
        model = made.build(device=device, dtype=dtype, copies=copies)
        lines = []
        tracker.report_func = lines.append
        tracker.report(max_items=100)
    report = model.report()
    number = np.dtype(dtype).itemsize
    shared = (3 + 3 + 1 + 1) * number * copies * VERTICES + 3 * number * copies + 4 + 4 * 3 * number
    of_terms = []
    for term, elements in zip(terms, model.terms, strict=True):
        E, K = len(term.stencil(MESH)), term.term.vertices
        values = E * copies if np.ndim(term.stiffness) else 1
        of_terms.append(4 * K * E * copies + number * (term.term.parameters * E * copies + values))
        assert elements.stiffness.strides == ((number,) if np.ndim(term.stiffness) else (0,))
        assert (elements.stiffness.numpy().reshape(copies, E) == np.asarray(term.stiffness, dtype=dtype)).all()
    assert [term["bytes"] for term in report["terms"]] == of_terms
    assert [term["elements"] for term in report["terms"]] == [copies * len(term.stencil(MESH)) for term in terms]
    assert [term["term"] for term in report["terms"]] == [type(term).__name__ for term in terms]
    assert report["bytes"] == shared + sum(of_terms)
    allocations = [line for line in lines[0].splitlines() if " : array" in line]
    assert len(allocations) == 7 + 3 * len(terms)
    # The tracker rounds what it prints to three digits.
    units = {"B": 1, "KB": 1024, "MB": 1024**2}
    tracked = [float(line.split()[0]) * units[line.split()[1]] for line in allocations]
    assert abs(sum(tracked) - report["bytes"]) <= 0.005 * 1024 * len(tracked)
    assert report["vertices"] == copies * VERTICES and report["copies"] == copies and report["dtype"] == dtype
    assert report["kernels"] == []
    json.dumps(report)


def test_report_names_the_kernels_and_their_variants(device):
    model = scene().build(device=device, copies=np.int64(2))  # any whole number
    way = "gather" if model.device.is_cuda else "scatter"
    Gradient(model)
    assert model.count == 2 * VERTICES and model.report()["kernels"] == [f"{way}_gradient.Spring"]
    Gradient(model, corrected=True)
    assert model.report()["kernels"] == [f"{way}_gradient(corrected).Spring", f"{way}_gradient.Spring"]
    json.dumps(model.report())


def test_report_numbers_terms_of_one_label(device):
    """In the report alone: vary by class still means all of them."""
    terms = [wc.Spring(stiffness=1.0), wc.Spring(pairs="shear", stiffness=1.0), wc.Spring(stiffness=1.0, name="warp")]
    model = scene(terms=[*terms, wc.Spring(stiffness=1.0)]).build(device=device, vary={"Spring.stiffness": [7.0]})
    assert [term["term"] for term in model.report()["terms"]] == ["Spring", "Spring 2", "warp", "Spring 3"]
    assert [elements.stiffness.numpy()[0] for elements in model.terms] == [7.0] * 4


# --- copies

COPIES = 3
STARTS = MESH.points + np.random.default_rng(0).normal(scale=0.03, size=(COPIES, VERTICES, 3))
BENDS = np.random.default_rng(2).uniform(1e-3, 2e-3, (COPIES, HINGES))
HOLDS = np.random.default_rng(3).uniform(1, 2, (COPIES, 4))
VARIED = {
    "gravity": ([[0, -9.81, 0], [0, -1.62, 0], [1, 2, 3]], lambda value: {"gravity": value}),
    "density": ([0.1, 0.2, 0.4], lambda value: {"density": value}),
    "positions": (STARTS, lambda value: {"positions": value}),
    "velocities": (np.random.default_rng(1).normal(size=(COPIES, VERTICES, 3)), lambda value: {"velocities": value}),
    "Spring.stiffness": ([10.0, 20.0, 40.0], lambda value: {"terms": all_terms(spring=value)}),
    "bend.stiffness": (BENDS, lambda value: {"terms": all_terms(bend=value)}),
    "Attachment.stiffness": (HOLDS, lambda value: {"terms": all_terms(hold=value)}),
}


def stretched(model):
    """U (B,) and ∂U/∂x (B, n, 3) of copies that are a little larger than where they start."""
    energy, gradient = energy_and_gradient(model, model.positions.numpy() * 1.05)
    return energy, gradient.reshape(model.copies, -1, 3)


def test_a_sum_replaces_what_an_overflow_left(device):
    """After a trial whose energy was infinite the next one counts alone."""
    model = scene().build(device=device)
    values = wp.full(model.count, 2.0, dtype=wp.float64, device=device)
    out = wp.full(1, np.nan, dtype=wp.float64, device=device)
    sums = Sums(model)
    sums.sum(values, model.count, out)
    assert out.numpy()[0] == 2.0 * model.count
    sums.sum(values, model.count, out, accumulate=1)
    assert out.numpy()[0] == 4.0 * model.count


def test_an_update_writes_what_changed(device):
    """The first one always, for the host does not know the array."""
    mirror, written = Mirror(wp.full(2, 3, dtype=wp.int32, device=device)), []
    write, mirror.write = mirror.write, lambda values: (written.append(list(values)), write(values))
    for values in ([3, 3], [3, 3], [1, 3]):
        mirror.update(np.array(values))
        assert (mirror.array.numpy() == values).all()
    assert written == [[3, 3], [1, 3]]


@pytest.mark.parametrize("dtype", DTYPES)
def test_sums_and_maxima(dtype, device, monkeypatch):
    """Sums, products and maxima of each copy, but for copies that are left out; on CUDA with more entries than lanes."""
    monkeypatch.setattr(of_copies, "MAX_BLOCKS", 2)
    model = scene().build(device=device, dtype=dtype, copies=COPIES)
    random, n, rows = np.random.default_rng(5), model.per_copy, 1100
    a, b = (random.normal(size=(COPIES, n, 3)).astype(dtype) for _ in range(2))
    c, d = (random.normal(size=(COPIES, rows)).astype(dtype) for _ in range(2))
    weights, values = random.uniform(size=(COPIES, n)).astype(dtype), random.uniform(size=(COPIES, n))
    active = wp.array([1, 0, 1], dtype=wp.int32, device=device)
    of_vertices, of_rows = Sums(model), RowSums(model, rows)

    def array(values, kind):
        return wp.array(values.reshape(-1, 3) if kind is model.vec3 else values.ravel(), dtype=kind, device=device)

    def found(launch, *given):
        out = wp.full(COPIES, -1.0, dtype=wp.float64, device=device)
        launch(*given, out)
        return out.numpy()

    exact = {"sum": values.sum(axis=1), "dot": (a * b.astype(float)).sum(axis=(1, 2))}
    exact |= {"rows": (c * d.astype(float)).sum(axis=1)}
    measured = {
        "sum": found(lambda each, out: of_vertices.sum(each, n, out), array(values, wp.float64)),
        "dot": found(lambda *each: of_vertices.dot(*each, active), array(a, model.vec3), array(b, model.vec3)),
        "rows": found(lambda *each: of_rows.dot(*each, active), array(c, model.dtype), array(d, model.dtype)),
    }
    for name, total in exact.items():
        some = slice(None) if name == "sum" else [0, 2]
        # Products of vectors are rounded once in the precision of the model.
        assert np.abs(measured[name] - total)[some].max() <= 8 * np.finfo(dtype).eps * n
    largest = found(of_vertices.largest, array(weights, model.dtype), array(a, model.vec3))
    assert largest == pytest.approx((weights * np.linalg.norm(a, axis=2)).max(axis=1), rel=8 * float(np.finfo(dtype).eps))
    assert (found(of_rows.largest, array(np.abs(c).astype(float), wp.float64)) == np.abs(c).max(axis=1)).all()


@pytest.mark.parametrize("names", [[name] for name in VARIED] + [list(VARIED)], ids=[*VARIED, "all at once"])
@pytest.mark.parametrize("dtype", slow_but(["float64"], DTYPES))
def test_a_copy_is_a_scene_of_its_own(names, dtype, device):
    """Copy b has the arrays, the energy and the forces of a single scene with its parameters, to the bit."""
    fields = {"terms": all_terms(), "pins": [0], "positions": STARTS[0]}
    vary = {name: VARIED[name][0] for name in names}
    batch = scene(**fields).build(device=device, dtype=dtype, copies=COPIES, vary=vary)
    energy, gradient = stretched(batch)
    differs = []
    for b in range(COPIES):
        changed = dict(fields)
        if len(names) > 1:
            changed["terms"] = all_terms(*(VARIED[f"{term}.stiffness"][0][b] for term in ("Spring", "bend", "Attachment")))
        for name in names:
            value = VARIED[name][1](VARIED[name][0][b])
            changed |= value if len(names) == 1 or "terms" not in value else {}
        single = scene(**changed).build(device=device, dtype=dtype)
        for field in ("positions", "velocities", "mass", "inverse_mass", "gravity"):
            whole = getattr(batch, field).numpy()
            assert (np.split(whole, COPIES)[b] == getattr(single, field).numpy()).all()
        energy_alone, gradient_alone = stretched(single)
        assert energy[b] == energy_alone[0] > 0.0 and (gradient[b] == gradient_alone[0]).all()
        differs.append([energy_alone[0], *single.mass.numpy(), *single.velocities.numpy().ravel(), *single.gravity.numpy()[0]])
    assert (np.ptp(differs, axis=0) > 0.0).any(), "the copies are not alike"


NUMBERS = [(kind, field) for kind, energy in KINDS.items() if kind in DECLARED for field in energy.quantities()]


def numbers_vary(kind, fields, by_element):
    """Checks that each copy has the arrays of a scene with its numbers, to the bit."""
    term, random = DECLARED[kind](MESH), np.random.default_rng(7)
    found = term.elements(MESH, MESH.points)
    count = len(found.stencil if found.cells is None else found.cells[1:]) if by_element else None
    values = {}
    for field in fields:
        shape = (COPIES, *([count] if by_element else []), *term.quantities()[field].shape)
        values[field] = random.uniform(0.5, 0.7, shape) + (0.5 if field == "most" else 0.0)
    vary = {f"{kind}.{field}": each for field, each in values.items()}
    batch = scene(terms=[term]).build(copies=COPIES, dtype="float64", vary=vary).terms[0]
    for b in (0, COPIES - 1):
        alone = scene(terms=[replace(term, **{field: each[b] for field, each in values.items()})]).build(dtype="float64")
        (alone,) = alone.terms
        for name in ("stiffness", "rest", "damping"):
            of_batch, of_one = (getattr(elements, name) for elements in (batch, alone))
            if of_one is not None:
                assert (of_batch.numpy().reshape(COPIES, alone.count, -1)[b] == of_one.numpy().reshape(alone.count, -1)).all()
        if alone.cells:
            weights = batch.cells.weights.numpy().reshape(COPIES, alone.count, -1)[b]
            assert (weights == alone.cells.weights.numpy()).all()


@pytest.mark.parametrize(("kind", "field"), NUMBERS, ids=map(".".join, NUMBERS))
def test_any_number_of_a_term_varies(kind, field):
    numbers_vary(kind, [field], by_element=False)


@pytest.mark.parametrize("kind", dict(NUMBERS))
def test_numbers_of_a_term_vary_by_element(kind):
    """One beside others that do not, and all together."""
    fields = [field for each, field in NUMBERS if each == kind]
    for varied in [[field] for field in fields] + [fields]:
        numbers_vary(kind, varied, by_element=True)


# Names given to two spring terms; what is varied; the stiffness of each term in the second copy.
TWO_SPRINGS = {
    "by name": ({"structural.stiffness": [1.0, 2.0]}, [2.0, 5.0]),
    "by the other name": ({"shear.stiffness": [1.0, 2.0]}, [3.0, 2.0]),
    "by class": ({"Spring.stiffness": [1.0, 2.0]}, [2.0, 2.0]),
    "name before class": ({"Spring.stiffness": [1.0, 2.0], "shear.stiffness": [6.0, 7.0]}, [2.0, 7.0]),
}


@pytest.mark.parametrize(("vary", "expected"), TWO_SPRINGS.values(), ids=TWO_SPRINGS)
def test_two_terms_of_a_kind(vary, expected, device):
    terms = [wc.Spring(pairs=kind, stiffness=k, name=kind) for kind, k in (("structural", 3.0), ("shear", 5.0))]
    model = scene(terms=terms).build(device=device, copies=2, vary=vary)
    assert [term["term"] for term in model.report()["terms"]] == ["structural", "shear"]
    found = [np.unique(elements.stiffness.numpy()[elements.per_copy :]).tolist() for elements in model.terms]
    assert found == [[value] for value in expected]


# --- nothing undeclared

PROBE = """
import inspect, json, os, sys
import warp as wp

launched, loaded, rows = {}, set(), set()
launch, load, make = wp.launch, wp.Module.load, wp.array.__init__

def recorded_launch(kernel, *args, **kwargs):
    launched[kernel.module.name] = kernel
    return launch(kernel, *args, **kwargs)

def recorded_load(module, *args, **kwargs):
    loaded.add(module.name)
    return load(module, *args, **kwargs)

def recorded_make(self, *args, **kwargs):
    make(self, *args, **kwargs)
    rows.update(self.shape[:1])

def homes(function, seen):
    # Files of all device functions that a kernel can call, found through what its Python source refers to.
    names = inspect.getclosurevars(function)
    for value in [*names.nonlocals.values(), *names.globals.values()]:
        if isinstance(value, wp.Function) and value.func is not None and value.func not in seen:
            seen.add(value.func)
            homes(value.func, seen)
    return {each.__module__ for each in seen}

wp.launch, wp.Module.load, wp.array.__init__ = recorded_launch, recorded_load, recorded_make
import numpy as np
import warpcloth as wc

def probe(solver, declared, device):
    for record in (launched, loaded, rows):
        record.clear()
    mesh = wc.Mesh.grid(7, 5, pattern="alternating")
    terms = [wc.Spring(stiffness=100.0)]
    if declared == "all":
        terms += [wc.QuadraticBending(stiffness=1e-4), wc.DihedralBending(stiffness=1e-4)]
        terms += [wc.Attachment(vertices=list(range(1, 34)), stiffness=10.0)]
    model = wc.Scene(mesh, density=0.1, terms=terms, pins=[0]).build(device=device)
    stepper = getattr(wc, solver)(substeps=8).bind(model)
    stepper.step()
    stepper.step()
    wp.synchronize()
    assert np.isfinite(stepper.state.x.numpy()).all()
    return {
        "homes": sorted(set().union(*(homes(kernel.func, {kernel.func}) for kernel in launched.values()))),
        "named": sorted(model.kernels),
        "launched": sorted(launched),
        "loaded": sorted(loaded),
        "compiled": sorted(name for name in os.listdir(empty) if os.path.isdir(os.path.join(empty, name))),
        "rows": sorted(rows),
    }

device, builds, empty, counted = sys.argv[1], json.loads(sys.argv[2]), sys.argv[3], int(sys.argv[4])
wp.init()
cache, level = wp.config.kernel_cache_dir, wp.config.optimization_level
found = []
for k, build in enumerate(builds):
    counts = k < counted  # what is compiled is counted, and hardly runs
    wp.config.kernel_cache_dir, wp.config.optimization_level = (empty, 0) if counts else (cache, level)
    found.append(probe(*build, device))
print(json.dumps(found))
"""


# Solver; terms of the scene; which files of energies are found in kernels; names in the report.
ALL_HOMES = ["attachment", "dihedral_bending", "quadratic_bending", "spring"]
ALL_NAMES = ["Attachment", "DihedralBending", "QuadraticBending", "Spring"]
BUILDS = {"PBD of all, to show that the probe sees them": ("PBD", "all", ALL_HOMES, ALL_NAMES)}
COUNTED = len(BUILDS)  # that many are compiled into an empty cache, the others into that of the tests
BUILDS |= {
    **{f"{each.__name__} of springs": (each.__name__, "springs", ["spring"], ["Spring"]) for each in SOLVERS.values()},
    # The levels are bounds, which are one-sided springs.
    "HierarchicalPBD of springs": ("HierarchicalPBD", "springs", ["spring", "spring_limit"], ["Spring", "SpringLimit"]),
}


@pytest.fixture(scope="module")
def probed(tmp_path_factory, device):
    """By build, what a new process builds, loads and launches, and has compiled so far into an empty kernel cache."""
    empty, builds = str(tmp_path_factory.mktemp("cache")), json.dumps([build[:2] for build in BUILDS.values()])
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", PROBE, device, builds, empty, str(COUNTED)]
    run = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=600, cwd=Path(__file__).parent)
    assert run.returncode == 0, run.stderr
    return dict(zip(BUILDS, json.loads(run.stdout.splitlines()[-1]), strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("name", BUILDS)
def test_nothing_undeclared_exists(name, probed):
    found, (_solver, _declared, homes, names) = probed[name], BUILDS[name]
    assert [home.rpartition(".")[2] for home in found["homes"] if ".kernels.terms." in home] == homes
    assert sorted({named.partition(".")[2] for named in found["named"] if "." in named}) == names
    # Each kernel is a module of its own; what was loaded is what was launched, and no more than the report names.
    assert found["loaded"] == found["launched"] and len(found["launched"]) <= len(found["named"])
    # One array at least has a row for each element of what is declared, and none has one for anything else.
    assert EDGES in found["rows"]
    assert (HINGES in found["rows"]) == ("QuadraticBending" in names)
    assert (ATTACHED in found["rows"]) == ("Attachment" in names)


@pytest.mark.slow
def test_nothing_is_compiled_that_is_not_launched(probed):
    """Folders of the cache are named wp_<module>_<7 digits>; one has the parsed headers."""
    counted = list(probed.values())[:COUNTED]
    launched = {module for each in counted for module in each["launched"]}
    folders = [folder for folder in counted[-1]["compiled"] if not folder.startswith(HEADERS)]
    assert {folder[3:-8] for folder in folders} == launched


@pytest.mark.parametrize("name", slow_but(["xpbd"], SOLVERS))
def test_binding_reads_no_elements_back(name, device, monkeypatch):
    """Stencils, stiffness and rest states stay on the host until they are final, in an order of the model's own too."""
    # On the CPU, where all is on the host, what reads them asks for what is kept.
    mesh = wc.Mesh.grid(5, 5)
    terms = [wc.Spring(pairs=("structural", "shear"), stiffness=np.linspace(50.0, 100.0, 72), damping=0.01)]
    scene = wc.Scene(mesh, density=0.1, terms=[*terms, wc.QuadraticBending(stiffness=1e-5)], pins=[0, 4])
    model = scene.build(device=device, copies=2, order=np.random.default_rng(0).permutation(25))
    own = {array.ptr for elements in model.terms for array in (*elements.arguments, elements.damping) if array is not None}
    read, numpy = set(), wp.array.numpy

    def copied_back(array):
        if sys._getframe(1).f_code is not host_values.__code__ or not array.device.is_cpu:
            read.add(array.ptr)
        return numpy(array)

    monkeypatch.setattr(wp.array, "numpy", copied_back)
    SOLVERS[name](substeps=50).bind(model)
    assert read and not own & read


def test_incidences_name_each_corner_once():
    stencil = np.array([[3, 0], [0, 1], [3, 1]])
    offsets, codes = incidences_of(stencil.ravel(), 5)
    assert [codes[first:last].tolist() for first, last in pairwise(offsets)] == [[1, 2], [3, 5], [], [0, 4], []]
