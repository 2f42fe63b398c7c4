"""Meshes of several parts: joined, selected from, acted on by part, and solved as each part is alone."""

import numpy as np
import pytest

import warpcloth as wc
from support.rows import slow_but
from warpcloth.usd import read_scene, write_scene

SKIRT, BELT = wc.Mesh.grid(6, 5, size=(0.5, 0.4)), wc.Mesh.grid(7, 4, size=0.6, pattern="equilateral")


def garment():
    belt = wc.Mesh(BELT.points + np.array([0.0, 0.3, 0.0]), BELT.triangles, texture_coordinates=BELT.texture_coordinates)
    return wc.Mesh.join({"skirt": SKIRT, "belt": belt}), belt


def test_parts_come_back():
    mesh, belt = garment()
    for name, one in (("skirt", SKIRT), ("belt", belt)):
        found = mesh.part(name)
        for field in ("points", "triangles", "edges", "texture_coordinates"):
            np.testing.assert_array_equal(getattr(found, field), getattr(one, field))
        assert found.grid_shape == one.grid_shape
        assert mesh.select(f"part({name})").tolist() == (mesh.parts[name].first + np.arange(len(one.points))).tolist()
    assert mesh.corners().tolist() == [*SKIRT.corners(), *(30 + belt.corners())]
    assert mesh.springs("structural").tolist() == [*SKIRT.springs("structural").tolist(), *(30 + belt.edges).tolist()]
    chains = wc.Mesh.join({"one": wc.Mesh.chain(3), "two": wc.Mesh.chain(4)})
    assert chains.edges.tolist() == [[0, 1], [1, 2], [3, 4], [4, 5], [5, 6]] and chains.part("two").edges.tolist()[0] == [0, 1]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda mesh: wc.Mesh.join({}), "one part or more"),
        (lambda mesh: wc.Mesh.join([SKIRT]), "mapping of names to meshes"),
        (lambda mesh: wc.Mesh.join({"a": SKIRT, "b": wc.Mesh.chain(3)}), "must be of one kind"),
        (lambda mesh: wc.Mesh.join({"a": mesh, "b": SKIRT}), "the mesh 'a' has parts itself"),
        (lambda mesh: wc.Mesh(mesh.points, mesh.triangles, parts=[30, 28]), r"must be a dict of"),
        (lambda mesh: wc.Mesh(mesh.points, mesh.triangles, parts={"a": 58}), r"must be a dict of"),
        (lambda mesh: wc.Mesh(mesh.points, mesh.triangles, parts={"a": (0, "58")}), r"must be a dict of"),
        (lambda mesh: wc.Mesh(mesh.points, mesh.triangles, parts={"a": (0, 58), "b": (58, 0)}), "must have all 58 vertices"),
        (lambda mesh: wc.Mesh.join({"a b": SKIRT}), "'a b' must be letters"),
        (lambda mesh: wc.Mesh(mesh.points, mesh.triangles, parts={"a": (0, 31), "b": (31, 27)}), "must lie in one part"),
        (lambda mesh: wc.Mesh(mesh.points, mesh.triangles, parts={"a": (0, 30)}), "must have all 58 vertices"),
        (lambda mesh: mesh.part("hem"), "no part 'hem'; its parts are skirt, belt"),
        (lambda mesh: SKIRT.part("skirt"), "Mesh.join makes one of parts"),
        (lambda mesh: mesh.select("part(hem)"), "expected skirt or belt"),
        (lambda mesh: SKIRT.select("part(skirt)"), "expected a mesh of parts"),
        (lambda mesh: mesh.springs("shear"), "four-sided cells"),
        (lambda mesh: wc.Spring(stiffness=1.0, part=3), "Spring.part is 3"),
        (lambda mesh: wc.Scene(mesh, density=0.1, terms=[wc.Spring(stiffness=1.0, part="hem")]).build(), "no part 'hem'"),
        (lambda mesh: wc.Scene(SKIRT, density=0.1, terms=[wc.Spring(stiffness=1.0, part="a")]).build(), "no part 'a'"),
    ],
)
def test_wrong_parts_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make(garment()[0])


def scene(mesh, **more):
    return wc.Scene(mesh, density=0.1, duration=0.1, fps=60.0, **more)


SOLVERS = {
    "newton": wc.Newton(substeps=2, tolerance=1e-12),
    "projective-dynamics": wc.ProjectiveDynamics(substeps=2, iterations=300, tolerance=1e-12),
    "admm": wc.ADMM(substeps=2, iterations=600, tolerance=1e-12),
    "pbd": wc.PBD(substeps=2, sweep="sequential"),
    "xpbd": wc.XPBD(substeps=2, sweep="sequential"),
    "constrained-dynamics": wc.ConstrainedDynamics(substeps=2, iterations=10, tolerance=1e-9, linear="factorised"),
}
# HierarchicalPBD is left out, because its levels depend on the whole mesh, and Explicit, which test_joining.py has.
# Of methods that stop at a tolerance of 1e-12 of the whole, or after so many iterations of each, and of sums over all vertices.
NEAR = dict.fromkeys(("newton", "projective-dynamics", "admm", "constrained-dynamics"), 1e-9)


@pytest.mark.parametrize("name", slow_but(("newton", "xpbd"), SOLVERS))
def test_parts_move_as_each_does_alone(name):
    """Two sheets that nothing joins, one of springs and one of a membrane, beside each sheet by itself."""
    mesh, belt = garment()
    springs = {"stiffness": 80.0, "pairs": ("structural", "shear")}
    sheet = [wc.Spring(**springs), wc.QuadraticBending(stiffness=1e-4)]
    band = [wc.CorotatedMembrane(stiffness=60.0), wc.QuadraticBending(stiffness=2e-4)]
    both = [
        wc.Spring(**springs, part="skirt"),
        wc.QuadraticBending(stiffness=1e-4, part="skirt", name="bending of the skirt"),
        wc.CorotatedMembrane(stiffness=60.0, part="belt"),
        wc.QuadraticBending(stiffness=2e-4, part="belt", name="bending of the belt"),
    ]
    whole, *alone = (
        wc.simulate(scene(one, terms=terms, pins="corners"), SOLVERS[name], dtype="float64", frames=3).points
        for one, terms in ((mesh, both), (SKIRT, sheet), (belt, band))
    )
    np.testing.assert_allclose(whole, np.concatenate(alone, axis=1), atol=NEAR.get(name, 1e-13))
    assert np.abs(whole[-1] - mesh.points).max() > 0.01


def test_a_seam_is_springs_between_parts():
    mesh, belt = garment()
    seam = wc.Spring(name="seam", pairs=[(0, 30), (5, 36)], stiffness=10.0, rest_lengths=0.0)
    model = scene(mesh, terms=[wc.Spring(stiffness=80.0, part="belt"), seam]).build()
    assert [elements.stencil.numpy().min() for elements in model.terms] == [30, 0]
    varied = scene(mesh, terms=[wc.Spring(stiffness=80.0, part="belt")])
    lengths = np.stack([np.full(len(belt.edges), 0.1), np.full(len(belt.edges), 0.2)])
    rest = varied.build(copies=2, vary={"Spring.rest_lengths": lengths}).terms[0].rest.numpy()
    assert rest.ravel().tolist() == pytest.approx(lengths.ravel().tolist())


def test_parts_go_through_a_stage(tmp_path):
    mesh, _ = garment()
    given = scene(mesh, terms=[wc.Spring(stiffness=80.0, pairs="structural", part="skirt")], pins="part(belt)")
    write_scene(given, tmp_path / "garment.usda")
    read = read_scene(tmp_path / "garment.usda")
    assert read.mesh.parts == mesh.parts and read.terms[0].part == "skirt"
    assert read.terms[0].elements(read.mesh, None).stencil.tolist() == SKIRT.springs("structural").tolist()
