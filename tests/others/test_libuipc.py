"""Scenes in libuipc: refusals, which do not need it; arrays, which need no GPU; motion, contact and stiffness on CUDA."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

import warpcloth as wc
from support.others import BENDING, MASSES, MESH, SPRINGS, declared
from warpcloth.cli import options
from warpcloth.others.runs import run_other
from warpcloth.others.simulators import SIMULATORS, shown_name
from warpcloth.others.uipc_calibration import calibrate
from warpcloth.others.uipc_model import engine, refuse_inexpressible, uipc_scene
from warpcloth.others.uipc_runs import LibUipc
from warpcloth.scenes import drape

MEMBRANE = wc.NeoHookeanMembrane(stiffness=300.0, poisson_ratio=0.3)
FLOOR = wc.Plane(position=(0.0, -5.0, 0.0), friction=0.2)
BALL = wc.Sphere(radius=0.5, position=(0.0, -3.0, 0.0), friction=0.1)
RAMP = wc.Capsule(radius=0.1, length=2.0, axis=(1.0, 0.0, 0.0), position=(0.0, -3.0, 4.0))
CARD = wc.MeshCollider([[0, -3, 0], [1, -3, 0], [0, -3, 1]], [[0, 1, 2]], position=(5.0, 0.0, 0.0))
CONTACT = wc.Contact(distance=2e-3, stiffness=3e3)


def test_meshes_that_are_not_those_of_its_bending_are_refused():
    curved = wc.Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.5]], [[0, 1, 2], [1, 3, 2]])
    with pytest.raises(ValueError, match="flat at rest on a mesh that is not, as QuadraticBending is"):
        refuse_inexpressible(wc.Scene(curved, density=0.1, terms=[BENDING]))
    refuse_inexpressible(wc.Scene(curved, density=0.1, terms=[wc.DihedralBending(stiffness=1e-2)]))
    line = wc.Mesh([[0, 0, 0], [1, 0, 0]], edges=[[0, 1]])
    with pytest.raises(ValueError, match="vertices outside of triangles"):
        refuse_inexpressible(wc.Scene(line, masses=[1.0, 1.0], terms=[wc.Spring(stiffness=1.0)]))


def test_a_cpu_is_refused_and_it_has_a_row():
    with pytest.raises(ValueError, match="device is 'cpu'; libuipc runs on CUDA only"):
        LibUipc(1).bind(declared(), "cpu")
    with pytest.raises(ValueError, match="iterations"):
        LibUipc(1, 0)
    assert tuple(SIMULATORS) == options._SIMULATORS
    assert shown_name("libuipc") == "libuipc: IPC" and SIMULATORS["uipc"].dtype == "float64"


def values(uipc, attributes, name):
    return np.array(uipc.view(attributes.find(name)))


@pytest.fixture
def uipc():
    pytest.importorskip("uipc", reason="libuipc is not installed: pip install -e '.[uipc]'")
    return engine()


def test_arrays_are_those_of_the_scene(uipc):
    """To the bit, but for products with the thickness: positions, velocities, masses, pins and the coefficients of energies."""
    rng = np.random.default_rng(0)
    positions, velocities = MESH.points + 0.1 * rng.random((16, 3)), rng.random((16, 3))
    pairs = SPRINGS.stencil(MESH)
    springs = wc.Spring(pairs=pairs, stiffness=1.0 + rng.random(len(pairs)), rest_lengths=0.3 + rng.random(len(pairs)))
    bending = wc.QuadraticBending(stiffness=rng.random(len(MESH.hinges)))
    membrane = replace(MEMBRANE, stiffness=1.0 + rng.random(len(MESH.triangles)))
    terms = [springs, bending, membrane]
    scene = declared(positions=positions, velocities=velocities, terms=terms, gravity=(1.0, -2.0, 3.0))
    made = uipc_scene(scene, 0.01, 3)
    cloth, rest = (slot.geometry() for slot in made.geometries().find(0))
    np.testing.assert_array_equal(np.array(uipc.view(cloth.positions()))[..., 0], positions)
    np.testing.assert_array_equal(np.array(uipc.view(rest.positions()))[..., 0], MESH.points)
    np.testing.assert_array_equal(values(uipc, cloth.vertices(), "velocity")[..., 0], velocities)
    np.testing.assert_array_equal(np.flatnonzero(values(uipc, cloth.vertices(), "is_fixed")), [0, 3])
    volume, density = (values(uipc, cloth.vertices(), name) for name in ("volume", "mass_density"))
    np.testing.assert_allclose(volume * density, MASSES, rtol=1e-15)
    thickness = 2.0 * values(uipc, cloth.vertices(), "thickness")[0]
    mu, lam = (thickness * values(uipc, cloth.triangles(), name) for name in ("mu", "lambda"))
    np.testing.assert_allclose(mu, membrane.stiffness / 2.6, rtol=1e-14)
    np.testing.assert_allclose(lam, membrane.stiffness * 0.3 / 0.91, rtol=1e-14)
    edges = np.array(uipc.view(cloth.edges().topo()))[..., 0].tolist()
    kappa = dict(zip(map(frozenset, edges), values(uipc, cloth.edges(), "bending_stiffness"), strict=True))
    hinges = map(frozenset, MESH.hinges[:, :2].tolist())
    assert {ends: 6.0 * k for ends, k in kappa.items() if k} == pytest.approx(dict(zip(hinges, bending.stiffness, strict=True)))
    stitches = made.geometries().find(1)[0].geometry().instances()
    np.testing.assert_array_equal(values(uipc, stitches, "topo")[..., 0], pairs)
    np.testing.assert_array_equal(values(uipc, stitches, "kappa"), springs.stiffness)
    np.testing.assert_array_equal(values(uipc, stitches, "rest_length"), springs.rest_lengths)
    config = {
        name: values(uipc, made.config(), name)[0].ravel().tolist() for name in ("gravity", "contact/enable", "newton/min_iter")
    }
    assert config == {"gravity": [1.0, -2.0, 3.0], "contact/enable": [0], "newton/min_iter": [2]}


def test_contact_begins_at_the_distances_of_the_scene(uipc):
    """With friction of each collider, between cloth and colliders and of cloth with itself only, in the shapes of the scene."""
    touching = wc.SelfContact(distance=3e-3, stiffness=4e3, friction=0.4)
    colliders = [FLOOR, BALL, RAMP, CARD]
    made = uipc_scene(declared(colliders=colliders, contact=CONTACT, self_contact=touching), 0.01)
    table = made.contact_tabular()
    enabled = [[table.at(i, j).is_enabled() for j in range(6)] for i in range(6)]
    assert np.array_equal(enabled, [[False] * 6, [False, *[True] * 5], *[[False, True, *[False] * 4]] * 4])
    assert [table.at(1, j).friction_rate() for j in range(1, 6)] == [0.4, 0.2, 0.1, 0.0, 0.0]
    area, half = MESH.vertex_areas.mean(), 3.0 * np.log(4.0) + 4.5
    at_half = [4e3 / 3e-3**2, 3e3 * 2e-3 / 3e-3**3, *[3e3 / 2e-3**2] * 3]
    assert [table.at(1, j).resistance() for j in range(1, 6)] == pytest.approx([area / half * k for k in at_half])
    shapes = [made.geometries().find(i)[0].geometry() for i in range(2, 6)]
    np.testing.assert_allclose(values(uipc, shapes[0].instances(), "P").ravel(), [0.0, -5.001, 0.0])
    for shape, collider in zip(shapes[1:], colliders[1:], strict=True):
        points = np.array(uipc.view(shape.positions()))[..., 0]
        np.testing.assert_allclose(collider.distances(points), 0.0, atol=1e-6)
        assert values(uipc, shape.meta(), "d_hat") == pytest.approx([1e-3])
        assert values(uipc, shape.instances(), "is_fixed") == [1]
    assert np.ptp(np.array(uipc.view(shapes[2].positions())), axis=0).ravel() == pytest.approx([2.2, 0.2, 0.2], rel=2e-3)


@pytest.fixture
def cuda(uipc):
    if not wp.is_cuda_available():
        pytest.skip("libuipc runs on CUDA only")
    return "cuda:0"


@pytest.mark.parametrize("terms", [[SPRINGS, BENDING], [MEMBRANE, BENDING]], ids=["springs", "membrane"])
def test_motion_converges_to_that_of_the_energies(cuda, terms):
    """At first order in the step, which is that of implicit Euler; the law of the membrane differs for large strains."""
    scene = declared(terms=terms, gravity=(1.0, -2.0, 3.0))
    exact = wc.simulate(scene, wc.Explicit(substeps=1000), dtype="float64", frames=6).points
    size = np.abs(exact[-1] - exact[0]).max()
    found = [run_other(scene, LibUipc(n, 6), cuda, frames=6) for n in (20, 40)]
    assert all(run.status.ok and run.points.dtype == np.float64 for run in found)
    errors = [np.abs(run.points - exact).max() for run in found]
    assert errors[1] < 0.05 * size and errors[1] < errors[0]
    np.testing.assert_allclose(found[0].points[:, [0, 3]], np.broadcast_to(MESH.points[[0, 3]], (7, 2, 3)), atol=1e-12)


def test_cloth_drapes_without_crossing(cuda):
    scene = drape.scene(n=24, self_contact=True)
    found = run_other(scene, LibUipc(2, 2), cuda, frames=30)
    assert found.status.ok and (scene.colliders[0].distances(found.points) > -1e-3).all()
    pytest.importorskip("igl")
    assert wc.intersections(found).clean


def test_samples_are_as_stiff_there(cuda):
    """Within 1 %: a strip of springs, one of a membrane, and a cantilever, at rest."""
    assert list(calibrate(cuda)) == pytest.approx([1.0] * 3, abs=0.01)
