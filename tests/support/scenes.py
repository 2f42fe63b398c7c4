"""The scenes of the package at sizes that take a moment, and some that move a lot."""

from dataclasses import replace
from importlib import import_module

import numpy as np

import warpcloth as wc
from support.meshes import PAIR
from warpcloth.solvers.explicit import step_limits


def scene(name, **parameters):
    return import_module(f"warpcloth.scenes.{name}").scene(**parameters)


def incline(angle, friction, duration=0.1, n=3, size=0.1, **fields):
    """The scene ``incline`` at so many degrees with some fields replaced, the normal of its slope, and the direction down."""
    declared = scene("incline", angle=angle, friction=friction, n=n, size=size, duration=duration)
    normal = declared.colliders[0].normal
    return replace(declared, **fields), normal, np.array([normal[1], -normal[0], 0.0])


def noisy(declared, size):
    """A scene whose free vertices start with noise [m]."""
    noise = size * np.random.default_rng(0).normal(size=declared.positions.shape)
    noise[declared.pins.vertices] = 0.0
    return replace(declared, positions=declared.positions + noise)


LIVELY = {
    "springs shorter than the cloth": (
        lambda mesh: {
            "terms": [wc.Spring(stiffness=1e5, rest_lengths=0.9 * mesh.edge_lengths)],
            "density": 0.1,
            "pins": [0, 7],
        },
        wc.Mesh.grid(8, 8, pattern="alternating"),
    ),
    "an attachment far away": (
        lambda mesh: {
            "terms": [wc.Attachment(vertices=[1], targets=[[3.0, 0.0, 0.0]], stiffness=1e3)],
            "masses": [1.0, 1e-3],
            "pins": [0],
        },
        PAIR,
    ),
    "a heavy pin": (
        lambda mesh: {
            "terms": [wc.Spring(stiffness=1e3)],
            "masses": [1e6, 1e-3],
            "pins": [0],
            "positions": [[0.0, 0.0, 0.0], [1.2, 0.0, 0.0]],
        },
        PAIR,
    ),
}
SMALL = {
    "hanging": {"n": 8},
    "cantilever": {"elements": 6, "stretching": 1e3},
    "chain": {"links": 5},
    "catenary": {"links": 10, "stretching": 50.0},
    "flag": {"nx": 9, "ny": 6},
    "usd_cloth": {},
    "bar_twist": {"cells": 2},
    "bunny": {"stiffness": 10.0, "bending": 1e-4},
    "cards": {"n": 3},
    "loop": {"elements": 16},
    "stack": {"sheets": 2, "n": 4},
    "mobile": {"n": 5},
    "net": {"n": 6},
    "strip": {"elements": 4},
    "picture_frame": {"n": 3},
    "cusick": {"fabric": "silk", "rows": 4},
}
TOUCHING = {
    "incline": {"n": 4},
    "capstan": {"turns": 6},
    "overhang": {"elements": 20, "width": 0.05},
    "chain_over_edge": {"links": 30},
    "ring": {"elements": 12, "bending": 1e-3, "duration": 0.2},
    "drape": {"n": 9},
    "tablecloth": {"n": 9},
    "curtain": {"nx": 13, "ny": 9, "duration": 1.0},
    "character": {"duration": 0.5},
}
FOLDING = {
    "cards": {"n": 3, "friction": 0.1},
    "drape": {"n": 12, "self_contact": True},
    "loop": {"elements": 16},
    "stack": {"sheets": 3, "n": 5, "duration": 0.6},
    "fold": {"nx": 3, "ny": 13, "folds": 2},
    "twist": {"around": 12, "along": 8, "turns": 1.5, "duration": 0.8},
    "knot": {"along": 40, "across": 1, "duration": 0.8},
    "funnel": {"n": 9, "duration": 0.8},
    "sleeve": {"around": 12, "along": 6, "duration": 0.6},
    "winding": {"layers": 2, "width": 0.02, "edge": 0.02, "duration": 0.1},
}
QUICK = {
    "newton": wc.Newton(substeps=4),
    "explicit": wc.Explicit(substeps=256),
    "pbd": wc.PBD(substeps=4),
    "pbd plain": wc.PBD(substeps=4, sweep="jacobi", relaxation=0.25),
    "hierarchical pbd": wc.HierarchicalPBD(substeps=4),
    "xpbd": wc.XPBD(substeps=16, iterations=4),
    "projective dynamics": wc.ProjectiveDynamics(substeps=4),
    "projective dynamics plain": wc.ProjectiveDynamics(substeps=4, acceleration="none"),
    "admm": wc.ADMM(substeps=4),
    "constrained dynamics": wc.ConstrainedDynamics(substeps=4, iterations=4),
    "constrained dynamics searching": wc.ConstrainedDynamics(substeps=4, iterations=4, stabilisation="line-search"),
}


def taken(declared, solver, device):
    """A scene without what a solver refuses, and the solver, explicit steps with those that contact of cloth needs."""
    method, contact = QUICK[solver], declared.self_contact
    if "pbd" in solver and solver != "xpbd":
        declared = replace(declared, colliders=[replace(each, friction=0.0) for each in declared.colliders])
        if contact is not None:
            declared = replace(declared, self_contact=replace(contact, friction=0.0))
    if solver == "explicit" and contact is not None:
        method = explicit_steps(declared, device)
    return declared, method


def explicit_steps(declared, device):
    """Explicit steps of at most half the limit."""
    limit, _ = step_limits(declared.build(device=device))
    return wc.Explicit(substeps=int(np.ceil(2.0 / (declared.fps * limit))))
