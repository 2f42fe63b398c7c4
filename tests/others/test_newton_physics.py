"""Scenes in Newton, the physics engine: arrays, motion against the same method here, refusals, and stiffness by samples."""

import csv
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace

import numpy as np
import pytest
import warp as wp

import warpcloth as wc
from support.others import MESH, SPRINGS
from support.others import declared as net
from warpcloth.chart.pareto import plot_time
from warpcloth.cli import options
from warpcloth.lab import trajectory
from warpcloth.lab.campaign import Store
from warpcloth.lab.choosing import choose
from warpcloth.lab.measurements import SceneRef, Setup
from warpcloth.lab.own_reference import of_own, own_facts, own_reference, words_of_own
from warpcloth.lab.work_precision import time_diagram, write_csv
from warpcloth.others.newton_calibration import calibrate
from warpcloth.others.newton_model import METHODS, TAKES, newton_model
from warpcloth.others.newton_runs import NewtonPhysics
from warpcloth.others.runs import run_other
from warpcloth.others.simulators import SIMULATORS
from warpcloth.scenes import fold

newton = pytest.importorskip("newton", reason="Newton is not installed: pip install -e '.[newton]'")

TETRAHEDRON = wc.MeshCollider([[0, -3, 0], [1, -3, 0], [0, -2, 0], [0, -3, 1]], [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
FLOOR = wc.Plane(position=(0.0, -5.0, 0.0))
COLLIDERS = [
    FLOOR,
    wc.Sphere(radius=0.5, position=(0.0, -3.0, 0.0)),
    wc.Box(size=(1.0, 2.0, 3.0), position=(0.0, -3.0, 4.0), rotation=(0.0, 0.6, 0.0, 0.8)),
    wc.Capsule(radius=0.1, length=2.0, axis=(1.0, 0.0, 0.0), position=(0.0, -3.0, 0.0)),
    TETRAHEDRON,
]


def declared(**fields):
    return net(**({"terms": [SPRINGS]} | fields))


def float32(values):
    return np.asarray(values, dtype=np.float32)


@pytest.mark.parametrize("method", METHODS)
def test_arrays_are_those_of_the_scene_to_the_bit(method):
    rng = np.random.default_rng(0)
    positions, velocities = MESH.points + 0.1 * rng.random((16, 3)), rng.random((16, 3))
    pairs = SPRINGS.stencil(MESH)
    springs = wc.Spring(pairs=pairs, stiffness=rng.random(len(pairs)) + 1.0, damping=0.25)
    longer = replace(springs, rest_lengths=0.3 + rng.random(len(pairs)))
    terms = [replace(springs, damping=None) if method == "style3d" else longer, wc.QuadraticBending(stiffness=1e-3)]
    scene = declared(positions=positions, velocities=velocities, terms=terms, gravity=(1.0, -2.0, 3.0), colliders=COLLIDERS)
    model = newton_model(scene, method)
    expected = {"particle_q": positions, "particle_qd": velocities, "particle_mass": scene.vertex_masses}
    expected |= {"particle_radius": np.full(16, scene.contact.distance), "gravity": scene.gravity[None]}
    if method == "style3d":
        expected["tri_indices"] = MESH.triangles
        assert model.spring_count == 0
    else:
        expected |= {"spring_indices": pairs.ravel(), "spring_rest_length": longer.rest_lengths}
        expected |= {"spring_stiffness": longer.stiffness, "spring_damping": np.full(len(pairs), 0.25)}
        expected["edge_indices"] = MESH.hinges[:, [2, 3, 0, 1]]
        np.testing.assert_array_equal(model.edge_rest_angle.numpy(), 0.0)
    for name, values in expected.items():
        found = getattr(model, name).numpy()
        np.testing.assert_array_equal(found[:1] if name == "gravity" else found, np.asarray(values, dtype=found.dtype), name)
    held = np.isin(np.arange(16), [0, 3])
    np.testing.assert_array_equal(model.particle_flags.numpy() & int(newton.ParticleFlags.ACTIVE) == 0, held)
    np.testing.assert_array_equal(model.particle_inv_mass.numpy() == 0.0, held)


def test_self_contact_has_the_whole_surface():
    """Triangles and edges without energy are there too; contact of particles with each other and with shapes is apart."""
    contact = {"contact": wc.Contact(distance=0.01, stiffness=3e3), "colliders": [replace(FLOOR, friction=0.5)]}
    bending = wc.QuadraticBending(stiffness=2e-3, damping=1e-4)
    scene = declared(
        terms=[SPRINGS, bending], self_contact=wc.SelfContact(distance=0.02, stiffness=4e3, friction=0.1), **contact
    )
    model = newton_model(scene, "vbd")
    np.testing.assert_array_equal(model.tri_indices.numpy(), MESH.triangles)
    assert not model.tri_materials.numpy().any()
    edges = np.sort(model.edge_indices.numpy()[:, 2:], axis=1)
    np.testing.assert_array_equal(np.unique(edges, axis=0), np.unique(np.sort(MESH.edges, axis=1), axis=0))
    assert len(edges) == len(MESH.edges)
    stiffness, damping = model.edge_bending_properties.numpy().T
    np.testing.assert_allclose(damping, 0.05 * stiffness, rtol=1e-6)
    assert (stiffness > 0.0).sum() == len(MESH.hinges)
    area = MESH.vertex_areas.mean()
    of_shape = model.shape_material_ke.numpy()[0], model.shape_material_mu.numpy()[0]
    assert (model.soft_contact_ke, model.soft_contact_mu) == pytest.approx((4e3 * area, 0.1))
    assert 0.5 * (model.soft_contact_ke + of_shape[0]) == pytest.approx(3e3 * area)
    assert np.sqrt(model.soft_contact_mu * of_shape[1]) == pytest.approx(0.5)


@pytest.mark.slow
def test_a_sheet_that_folds_does_not_cross_itself_or_the_floor():
    """Within 0.5 s it lies on the floor and on itself; without self-contact in the model it crosses itself."""
    pytest.importorskip("igl")
    scene = fold.scene(nx=4, ny=16)
    found = run_other(scene, NewtonPhysics("vbd", 32, 5), frames=20)
    assert found.status.ok and wc.intersections(found).clean
    assert found.points[-1][:, 1].min() < 2.0 * scene.contact.distance
    assert not wc.intersections(run_other(replace(scene, self_contact=None), NewtonPhysics("vbd", 32, 5), frames=20)).clean


def test_shapes_are_those_of_the_scene():
    """Planes and capsules lie along z there, so that a unit vector shows their turn."""
    model = newton_model(declared(colliders=COLLIDERS), "xpbd")
    kinds = [newton.GeoType(kind).name for kind in model.shape_type.numpy()]
    assert kinds == ["PLANE", "SPHERE", "BOX", "CAPSULE", "MESH"]
    transforms, sizes = model.shape_transform.numpy(), model.shape_scale.numpy()
    np.testing.assert_array_equal(transforms[:, :3], float32([np.atleast_2d(each.position)[0] for each in COLLIDERS]))
    turned = [np.asarray(wp.quat_rotate(wp.quat(*map(float, q[3:])), wp.vec3(0.0, 0.0, 1.0))) for q in transforms[[0, 3]]]
    np.testing.assert_allclose(turned, [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]], rtol=0.0, atol=1e-6)
    np.testing.assert_array_equal(transforms[2, 3:], float32([0.0, 0.6, 0.0, 0.8]))
    np.testing.assert_array_equal(sizes[2], float32([0.5, 1.0, 1.5]))
    np.testing.assert_array_equal(sizes[3, :2], float32([0.1, 1.0]))
    np.testing.assert_array_equal(model.shape_source[4].vertices, float32(TETRAHEDRON.points))


@pytest.mark.parametrize(
    "term", [SPRINGS, wc.NeoHookeanMembrane(stiffness=300.0, poisson_ratio=0.3)], ids=lambda term: term.label
)
def test_semi_implicit_steps_are_explicit_steps(term, device):
    """Both are symplectic Euler; without damping, they differ by the rounding of float32, which grows with the motion."""
    scene = declared(terms=[term, wc.DihedralBending(stiffness=1e-2)])
    ours = wc.simulate(scene, wc.Explicit(substeps=40), device=device, frames=12)
    found = run_other(scene, NewtonPhysics("semi-implicit", 40), device=device, frames=12)
    assert found.status.ok and found.points.dtype == np.float32 and found.points.shape == ours.points.shape
    np.testing.assert_array_equal(found.points[0], float32(scene.positions))
    np.testing.assert_array_equal(found.points[:, [0, 3]], np.broadcast_to(float32(scene.positions)[[0, 3]], (13, 2, 3)))
    assert np.abs(ours.points[-1] - scene.positions).max() > 0.1
    np.testing.assert_allclose(found.points, ours.points, rtol=0.0, atol=1e-4)
    assert found.worst_strain == pytest.approx(ours.worst_strain, rel=1e-3)
    if device == "cpu":
        pytest.importorskip("igl")
        assert [len(frame.pairs) for frame in wc.intersections(found).frames] == [0] * 13


def test_a_run_that_diverges_ends_before_that_frame(device):
    found = run_other(
        declared(terms=[replace(SPRINGS, stiffness=1e5)]), NewtonPhysics("semi-implicit", 1), device=device, frames=30
    )
    assert not found.status.ok and len(found.points) == found.status.frame + 1 < 31
    assert "diverged in frame" in found.status.message and np.isfinite(found.points).all()


def test_hinges_between_different_triangles_are_refused():
    mesh = wc.Mesh([[0, 0, 0], [1, 0, 0], [0, 0, 1], [1, 0, -3]], [[0, 2, 1], [0, 1, 3]])
    scene = wc.Scene(mesh, density=1.0, terms=[wc.QuadraticBending(stiffness=1.0)], pins=[0])
    with pytest.raises(ValueError, match=r"both must be equal; hinge 0 of QuadraticBending has 0\.5 and 1\.5 m²"):
        newton_model(scene, "semi-implicit")
    # ∂²U/∂θ² = D|e|²/(A₁+A₂) = 1/2 with |e| = 1
    assert newton_model(scene, "vbd").edge_bending_properties.numpy()[0, 0] == 0.5


@pytest.mark.parametrize("method", ["semi-implicit", *(pytest.param(each, marks=pytest.mark.slow) for each in METHODS[1:])])
def test_samples_are_as_stiff_there(method):
    """Within 1 %: a strip of springs, one of a membrane, and a cantilever, at rest."""
    found = calibrate(method)
    assert (found.membrane is None) == (wc.NeoHookeanMembrane not in TAKES[method] and method != "style3d")
    assert [each for each in found if each is not None] == pytest.approx([1.0] * (2 + (found.membrane is not None)), abs=0.01)


def test_charts_and_choices_have_its_solvers(tmp_path, monkeypatch):
    """With one of the four, whose steps are those of Explicit, and so its errors, but for the angles of hinges."""
    monkeypatch.setenv("WARPCLOTH_CACHE", str(tmp_path / "cache"))
    name = "newton-semi-implicit"
    monkeypatch.setitem(SIMULATORS, "newton", SIMULATORS["newton"]._replace(solvers={name: SIMULATORS["newton"].solvers[name]}))
    scene, given = SceneRef("hanging", {"n": 4, "bending": 0.0}), {"frames": 6, "others": ["newton"], "solvers": ["explicit"]}
    with ThreadPoolExecutor(1) as executor:
        given |= {"executor": executor, "store": Store()}
        found = time_diagram(scene, limit=30.0, **given)
        choice, measured, exact = choose(scene, tolerance=0.01, **given)
    rows = {(row["solver"], row["options"]["substeps"]): row for row in found["rows"] if row["status"] == "ok"}
    ours = {substeps: row for (solver, substeps), row in rows.items() if solver == "explicit"}
    others = {substeps: row for (solver, substeps), row in rows.items() if solver == "newton-semi-implicit"}
    assert len(ours) == 3 and len(others) == 4 and set(ours) < set(others)
    for substeps, row in ours.items():
        assert others[substeps]["error"] == pytest.approx(row["error"], rel=0.05) and "own_error" not in row
    own = found["others"]["newton-semi-implicit"]
    assert own["converged"] and own["error"] <= own["bound"] == 1e-3 and own["apart"] < 1e-3
    assert all(abs(row["own_error"] - row["error"]) <= own["apart"] for row in others.values())
    assert found["machine"]["newton"] == newton.__version__
    plot_time(tmp_path / "chart.png", found)
    write_csv(tmp_path / "chart.csv", found)
    with (tmp_path / "chart.csv").open() as file:
        assert {(row["newton"], row["own_error"] != "") for row in csv.DictReader(file) if row["solver"] != "explicit"} == {
            (newton.__version__, True)
        }
    assert options._SIMULATORS == tuple(SIMULATORS)
    assert choice.meets and {each.setup.solver for each in measured} == {"explicit", "newton-semi-implicit"}
    assert all((each.own_error is None) == (each.setup.solver == "explicit") for each in measured if each.error is not None)
    assert choice.others[name]["converged"] and "other settings cost more" in choice.others[name]["searched"]
    rough = own_reference(scene, [Setup(name, {"substeps": 30})], 6, tolerance=1e-2)
    facts = own_facts(rough, exact, scene.load().mesh, 0.5 * rough.error)
    assert not facts["converged"] and words_of_own(facts).startswith(
        "not converged: two doublings up to 120 steps a frame moved it by"
    )
    assert of_own(rough, 0.5 * rough.error) == {} != of_own(rough, rough.error)
    refused = trajectory.measure(asdict(scene), asdict(Setup(name, {"substeps": 1})), frames=1, dtype="float64")
    assert refused["status"] == "refused" and "Newton engine has float32 only" in refused["reason"]
