"""Scenes of several cloths: each keeps its masses, terms, pins and loads, and moves as in a scene of its own."""

from dataclasses import replace

import numpy as np
import pytest

import warpcloth as wc
from support.rows import slow_but
from warpcloth.base.digest import scene_digest

# Explicit steps and sweeps take no number from another cloth. Newton's method has products and a tolerance over all vertices:
# 1e-4 of the move of a step, some 4 mm, in each of 12 steps.
SOLVERS = {
    "explicit": (wc.Explicit(substeps=80), 0.0),
    "xpbd": (wc.XPBD(substeps=4), 0.0),
    "pbd": (wc.PBD(substeps=4), 0.0),
    "hierarchical_pbd": (wc.HierarchicalPBD(substeps=2), 0.0),
    "newton": (wc.Newton(substeps=2, iterations=30), 5e-6),
}


def cloths():
    """A stiff heavy sheet whose pins are led, and a light one with a load and rollers, two metres apart."""
    grid, other = wc.Mesh.grid(6, 6), wc.Mesh.grid(7, 5, pattern="alternating")
    other = wc.Mesh(other.points + np.array([2.0, 0.0, 0.0]), other.triangles)
    start = grid.points[[0, 5]]
    given = {"density": 0.4, "terms": [wc.Spring(stiffness=1e3), wc.QuadraticBending(stiffness=1e-4)]}
    given |= {"pins": wc.Pins([0, 5], keyframes=[start, start + np.array([0.0, 0.01, 0.0])]), "duration": 0.1}
    heavy = wc.Scene(grid, **given)
    force = wc.Force(vertices=[34, 33], force=[[0.0, 0.01, 0.0], [0.0, 0.0, 0.02]])
    given = {"terms": [wc.Spring(stiffness=np.linspace(80.0, 120.0, len(other.edges)))], "pins": wc.Pins("x < 2.01", axes="xz")}
    given |= {"velocities": np.tile([0.0, 0.0, 0.3], (35, 1)), "loads": [force, wc.Pressure(vertices="all", pressure=1.0)]}
    light = wc.Scene(other, density=0.05, duration=0.1, **given)
    return {"heavy": heavy, "light": light}


def locked():
    """Cloths of which one moves in the plane x = const alone."""
    found = cloths()
    axes = np.ones((36, 3), dtype=bool)
    axes[:, 0] = False
    return found | {"heavy": replace(found["heavy"], free_axes=axes)}


@pytest.mark.parametrize("name", slow_but(("newton", "xpbd"), SOLVERS))
def test_each_moves_as_alone(name, device):
    """Bit for bit on the CPU, where each cloth has the kernels that it has alone."""
    solver, tolerance = SOLVERS[name]
    of = {key: replace(cloth, pins="x < 0.01 or x > 2.99", loads=()) for key, cloth in cloths().items()}
    compare(of, solver, device, tolerance if device == "cpu" else max(tolerance, 1e-9))


def test_loads_and_pins_stay_with_their_cloth(device):
    """Loads and rollers of one cloth take the other to other kernels too, which round otherwise: 480 steps of 1e-16 m."""
    compare(cloths(), wc.Explicit(substeps=80), device, 1e-12)


def compare(of, solver, device, tolerance):
    found = wc.simulate(wc.Scene.join(of), solver, device=device, dtype="float64")
    for cloth, alone in of.items():
        expected = wc.simulate(alone, solver, device=device, dtype="float64").points
        assert np.abs(expected[-1] - expected[0]).max() > 1e-2
        np.testing.assert_allclose(found.cloth(cloth), expected, rtol=0.0, atol=tolerance)


def test_fields():
    of = locked()
    scene = wc.Scene.join(
        of, name="both", self_contact=wc.SelfContact(stiffness=1e4), terms=[wc.Spring(pairs=[(5, 36)], stiffness=1.0)]
    )
    assert scene.cloths == ("heavy", "light") and scene.name == "both" and scene.frames == 6
    assert scene.vertex_masses.sum() == pytest.approx(0.45)
    assert scene.density is None and wc.Scene.join({"a": of["heavy"]}).density == 0.4
    assert scene.pins.vertices.tolist() == [0, 5, *(36 + of["light"].pins.vertices)]
    assert scene.pins.keyframes.shape == (2, 7, 3) and not np.ptp(scene.pins.keyframes[:, 2:], axis=0).any()
    assert scene.pins.held.tolist() == [[True] * 3] * 2 + [[True, False, True]] * 5
    assert not scene.free_axes[:36, 0].any() and scene.free_axes[36:].all()
    assert [term.name for term in scene.terms] == ["heavy_Spring", "heavy_QuadraticBending", "light_Spring", None]
    assert scene.loads[0].vertices.tolist() == [70, 69]
    assert "cloth light: 35 vertices, mass 0.05 kg" in str(scene)
    of = cloths()
    scene = wc.Scene.join(of)
    animation = wc.simulate(scene, wc.Explicit(substeps=80), frames=1)
    np.testing.assert_array_equal(animation.cloth("light"), animation.points[:, 36:])
    assert wc.simulate(scene, wc.Explicit(substeps=80), frames=1, copies=2).cloth("heavy").shape == (2, 2, 36, 3)
    assert scene_digest(scene) != scene_digest(replace(scene, self_contact=wc.SelfContact(stiffness=2e4)))


@pytest.mark.parametrize(
    ("join", "message"),
    [
        (lambda a, b: wc.Scene.join({}), "one cloth or more"),
        (lambda a, b: wc.Scene.join([a, b]), "mapping of names to scenes"),
        (lambda a, b: wc.Scene.join({"a b": a}), "'a b' must be letters"),
        (lambda a, b: wc.Scene.join({"a": a, "b": replace(b, duration=0.2)}), r"'a' and 'b' have duration 0.1 and 0.2"),
        (
            lambda a, b: wc.Scene.join({"a": a, "b": replace(b, gravity=(0, 0, 0))}),
            r"have gravity \[.*\] and \[0.0, 0.0, 0.0\]",
        ),
        (
            lambda a, b: wc.Scene.join({"a": replace(a, colliders=[wc.Plane(position=(0, -1, 0))])}),
            "'a' has colliders of its own",
        ),
        (lambda a, b: wc.Scene.join({"a": a}, density=1.0), "density is given for the whole scene"),
        (lambda a, b: replace(wc.Scene.join({"a": a, "b": b}), cloths=("a",)), "names of the parts of the mesh"),
        (lambda a, b: wc.simulate(a, wc.XPBD(substeps=1), frames=1).cloth("a"), "Scene.join makes one of several"),
    ],
)
def test_what_is_refused(join, message):
    with pytest.raises(ValueError, match=message):
        join(*({name: replace(each, pins=None) for name, each in cloths().items()}).values())
