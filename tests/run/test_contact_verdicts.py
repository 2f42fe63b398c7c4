"""Warnings about cloth that crosses a mesh from the start."""

from dataclasses import replace

import numpy as np
import pytest

import warpcloth as wc
from warpcloth.run.contact_verdicts import crossings_at_start

pytestmark = pytest.mark.host

SPIKE = [[-0.1, -0.3, -0.1], [0.1, -0.3, -0.1], [0.0, -0.3, 0.1], [0.013, 0.2, 0.007]]
FACES = [[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]]


def sheet(height, **fields):
    """A sheet of 9² vertices at a height [m], and a body whose tip is at 0.2 m."""
    grid = wc.Mesh.grid(9, 9, size=0.4)
    return wc.Scene(
        wc.Mesh(grid.points - [0.2, 0.0, 0.2], grid.triangles),
        density=0.1,
        positions=grid.points - [0.2, -height, 0.2],
        terms=[wc.Spring(stiffness=100.0)],
        colliders=[wc.MeshCollider(SPIKE, FACES, name="body")],
        contact=wc.Contact(distance=3e-3),
        **fields,
    )


def test_triangles_that_cross_a_mesh_at_the_start_are_counted():
    """A plane cuts the tip of a tetrahedron in a triangle. Triangles of the cloth that meet its sides cross."""
    hooked = sheet(0.15)
    (sentence,) = crossings_at_start(hooked.build())
    assert sentence == "3 triangles of the cloth cross the collider body at the start; they stay hooked"
    assert crossings_at_start(sheet(0.25).build()) == []
    assert crossings_at_start(sheet(0.2).build()) == []  # the tip only touches


def test_a_mesh_within_one_triangle_is_found_by_its_edges():
    (sentence,) = crossings_at_start(sheet(0.195).build())
    assert sentence == "1 triangle of the cloth crosses the collider body at the start; it stays hooked"


def test_pinned_triangles_do_not_count():
    """Pins may be inside a body."""
    middle = np.flatnonzero(np.linalg.norm(sheet(0.195).mesh.points, axis=1) < 0.1)
    assert crossings_at_start(sheet(0.195, pins=middle).build()) == []


def test_crossings_are_said_of_the_first_copy_and_of_moved_meshes():
    above = sheet(0.25)
    starts = np.stack([above.positions, above.positions, above.positions - [0.0, 0.1, 0.0]])
    (sentence,) = crossings_at_start(above.build(copies=3, vary={"positions": starts}))
    assert "at the start of copy 2" in sentence
    raised = replace(above, colliders=[replace(above.colliders[0], position=(0.0, 0.1, 0.0), rotation=(0.0, 1.0, 0.0, 0.0))])
    assert len(crossings_at_start(raised.build())) == 1
