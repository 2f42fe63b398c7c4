"""Vertices renumbered for memory: what a run gives is in the scene's own order, the same but for rounding."""

import json
import time
from dataclasses import asdict, replace

import numpy as np
import pytest

import warpcloth as wc
from support.relations import renumbered
from support.rows import slow_but
from warpcloth.cli import main
from warpcloth.lab.measurements import SceneRef, Setup
from warpcloth.lab.timing import measure
from warpcloth.mesh import ordering
from warpcloth.mesh.ordering import near_order, order_of_run, spread
from warpcloth.run import scene_files
from warpcloth.run.balance import Balance
from warpcloth.scenes import flag, hanging
from warpcloth.solvers.explicit import step_limits
from warpcloth.usd import FrameSequence


def shuffled(scene, seed=0):
    """A scene of springs and bending with its vertices in random order, and which vertex each is in the other."""
    changed, order = renumbered(scene, seed)
    springs, bending = scene.terms
    pairs = np.argsort(order)[springs.stencil(scene.mesh)]
    return replace(changed, density=0.1, masses=None, terms=[replace(springs, pairs=pairs), bending]), order


@pytest.fixture
def always(monkeypatch):
    """Small meshes are renumbered too."""
    monkeypatch.setattr(ordering, "MIN_VERTICES", 0)


@pytest.mark.parametrize("pattern", ["diagonal", "alternating", "equilateral"])
def test_neighbours_of_a_shuffled_grid_come_near(pattern):
    """Edges stay within a level of Cuthill and McKee's or lead to the next; from a corner a level is less than 2n vertices."""
    n = 24
    grid = wc.Mesh.grid(n, n, pattern=pattern)
    ranks = np.random.default_rng(2).permutation(n * n)
    mesh = wc.Mesh(grid.points[np.argsort(ranks)], ranks[grid.triangles])
    order = near_order(mesh)
    assert np.array_equal(np.sort(order), np.arange(n * n))
    assert np.abs(np.diff(np.argsort(order)[mesh.edges], axis=1)).max() < 4 * n
    # Of two ranks at random |i − j| is n²/3 in the mean; two levels of 2n at most leave less.
    assert spread(mesh, order) < 2 * n < 0.9 * n * n / 3 < spread(mesh)
    apart = wc.Mesh(np.random.default_rng(3).normal(size=(7, 3)), edges=[[6, 0], [2, 4]])  # parts are all there
    assert np.array_equal(np.sort(near_order(apart)), np.arange(7))


@pytest.mark.parametrize(
    ("solver", "wanted"),
    [
        (wc.Explicit(substeps=1), True),
        (wc.ProjectiveDynamics(substeps=1), True),
        (wc.PBD(substeps=1, sweep="jacobi"), True),
        (wc.XPBD(substeps=1, sweep="constraint-averaged"), True),
        (wc.PBD(substeps=1), False),
        (wc.PBD(substeps=1, sweep="sequential"), False),
        (wc.XPBD(substeps=1), False),
        (wc.HierarchicalPBD(substeps=1), False),
    ],
    ids=lambda value: getattr(value, "sweep", type(value).__name__),
)
def test_only_what_gains_and_does_not_change_is_renumbered(solver, wanted, monkeypatch):
    ordered = hanging.scene(n=16)
    random, _order = shuffled(ordered)
    assert order_of_run(random, solver) is None  # so few
    monkeypatch.setattr(ordering, "MIN_VERTICES", 256)
    assert (order_of_run(random, solver) is not None) == wanted
    assert order_of_run(ordered, solver) is None


SOLVERS = {
    "explicit": wc.Explicit(substeps=64),
    "newton": wc.Newton(substeps=4, tolerance=1e-10),
    "projective dynamics": wc.ProjectiveDynamics(substeps=4),
    "admm": wc.ADMM(substeps=4),
    "constrained dynamics": wc.ConstrainedDynamics(substeps=4),
    "pbd, averaged": wc.PBD(substeps=4, sweep="vertex-averaged"),
}


def moves_the_same(scene, solver, random, tolerance, **build):
    """Checks the state after 6 frames, in the order of the scene."""
    found = []
    for order in (None, random.permutation(len(scene.mesh.points))):
        stepper = solver.bind(scene.build(order=order, dtype="float64", **build))
        for _ in range(6):
            stepper.frame()
        found.append([stepper.model.in_scene_order(array.numpy()) for array in stepper.state])
    for as_declared, reordered in zip(*found, strict=True):
        np.testing.assert_allclose(reordered, as_declared, rtol=0, atol=tolerance)


@pytest.mark.parametrize("copies", slow_but([3], [1, 3]))
@pytest.mark.parametrize("solver", slow_but(("newton", "pbd, averaged"), SOLVERS))
def test_any_order_gives_the_same_motion(solver, copies, device):
    """Of everything that a scene names by vertex or element, and that copies vary; the order need not be a good one."""
    mesh = wc.Mesh.grid(6, 5, pattern="alternating")
    n, edges = len(mesh.points), len(mesh.edges)
    random = np.random.default_rng(5)
    positions = mesh.points * [1.01, 1.0, 1.02]
    keyframes = positions[[4, 0]] + 0.01 * np.arange(6)[:, None, None] * [1.0, 2.0, 0.0]
    lengths = random.uniform(0.19, 0.21, edges)
    terms = [
        wc.Spring(stiffness=random.uniform(50.0, 100.0, edges), rest_lengths=lengths),
        wc.QuadraticBending(stiffness=random.uniform(1e-4, 1e-3, len(mesh.hinges))),
        wc.Attachment(vertices=[7, 29], targets=[[0.0, 0.5, 0.0], [1.0, 0.2, 1.0]], stiffness=[1.0, 2.0]),
    ]
    start = {
        "positions": positions,
        "velocities": random.normal(scale=0.1, size=(n, 3)),
        "masses": random.uniform(1e-3, 2e-3, n),
    }
    scene = wc.Scene(mesh, terms=terms, pins=wc.Pins([4, 0], keyframes), duration=0.1, **start)
    vary = {"masses": random.uniform(1e-3, 2e-3, (copies, n)), "Spring.stiffness": random.uniform(50.0, 100.0, (copies, edges))}
    vary |= {"velocities": random.normal(scale=0.1, size=(copies, n, 3))}
    build = {"device": device, "copies": copies, "vary": vary if copies > 1 else None}
    moves_the_same(scene, SOLVERS[solver], random, 1e-9, **build)  # iterations end at different roundings, of 1e-16


def test_bodies_move_the_same_in_any_order(device):
    """Rigid clusters name vertices body by body, and their rest shape is about the centre of their masses."""
    mesh, random = wc.Mesh.grid(6, 5), np.random.default_rng(6)
    scene = wc.Scene(
        mesh,
        masses=random.uniform(1e-3, 2e-3, 30),
        terms=[wc.Spring(stiffness=50.0), wc.RigidCluster(vertices=[[0, 1, 7, 6], [29, 28, 22]], stiffness=1e3)],
        pins=[0],
    )
    moves_the_same(scene, wc.Explicit(substeps=32), random, 1e-11, device=device)


def test_what_is_found_of_a_scene_is_the_same_in_any_order(device):
    """Limits of the step, of terms that are at rest in the rest shape; and what a run is watched by."""
    mesh, random = wc.Mesh.grid(6, 5, pattern="equilateral"), np.random.default_rng(7)
    mesh = wc.Mesh(mesh.points + random.normal(scale=0.02, size=(30, 3)), mesh.triangles)
    terms = [wc.StrainLimit(stiffness=50.0, least=0.9, most=1.1), wc.DihedralBending(stiffness=1e-3)]
    scene = wc.Scene(mesh, masses=random.uniform(1e-3, 2e-3, 30), terms=terms, pins=[0, 5])
    one, other = (scene.build(device=device, dtype="float64", order=order) for order in (None, random.permutation(30)))
    np.testing.assert_allclose(step_limits(other), step_limits(one), rtol=1e-4)  # to which eigenvalues are found
    assert np.array_equal(*(Balance(model, wc.Newton(substeps=1).bind(model)).mass for model in (other, one)))


def test_elements_follow_their_vertices(device):
    """In the order of their lowest vertices, which of pairs come first; what each has goes with it."""
    scene, _order = shuffled(flag.scene(nx=6, ny=5))
    stiffness = np.arange(1.0, 1.0 + len(scene.terms[0].pairs))
    scene = replace(scene, terms=[replace(scene.terms[0], stiffness=stiffness), scene.terms[1]])
    order = near_order(scene.mesh)
    springs, hinges = scene.build(device=device, copies=2, order=order).terms
    for elements in (springs, hinges):
        assert (np.diff(elements.stencil.numpy().min(axis=1)) >= 0).all()
    stencil = springs.stencil.numpy()
    assert (stencil[:, 0] < stencil[:, 1]).all()
    half = len(stiffness)
    found = dict(zip(map(frozenset, order[stencil[half:] - 30].tolist()), springs.stiffness.numpy()[half:], strict=True))
    assert found == dict(zip(map(frozenset, scene.terms[0].pairs.tolist()), stiffness, strict=True))


@pytest.mark.parametrize("copies", [1, 2])
def test_frames_come_in_the_order_of_the_scene(copies, always, device):
    """A shuffled flag moves as the flag, vertex by vertex, though the model has them in another order."""
    plain = flag.scene(nx=12, ny=8, duration=0.2)
    random, order = shuffled(plain)
    solver = wc.Explicit(substeps=64)
    assert order_of_run(random, solver) is not None
    run = {"device": device, "dtype": "float64", "copies": copies}
    expected, found = (wc.simulate(scene, solver, **run) for scene in (replace(plain, density=0.1), random))
    np.testing.assert_allclose(found.points, expected.points[..., order, :], rtol=0, atol=1e-11)
    np.testing.assert_allclose(found.velocities, expected.velocities[..., order, :], rtol=0, atol=1e-9)
    assert found.worst_strain == pytest.approx(expected.worst_strain, rel=1e-9)


@pytest.mark.parametrize("ending", ["usdc", "usdz"])
def test_files_are_in_the_order_of_the_scene(ending, always, tmp_path, device):
    """Written, read, and run again from what was read."""
    random, _order = shuffled(flag.scene(nx=12, ny=8, duration=0.1))
    solver, output = wc.Explicit(substeps=64), tmp_path / f"out.{ending}"
    kept = wc.simulate(random, solver, device=device)
    wc.simulate(random, solver, device=device, output=str(output))
    mesh = wc.Mesh.load(output)
    assert np.array_equal(mesh.triangles, random.mesh.triangles)
    assert np.array_equal(np.asarray(FrameSequence(output)), kept.points)
    again = wc.simulate(replace(random, mesh=wc.Mesh(random.mesh.points, mesh.triangles)), solver, device=device)
    assert np.array_equal(again.points, kept.points)


def test_a_vertex_that_is_not_finite_has_its_own_number(always, device):
    """float32 does not hold the forces of the second step on a vertex that flies off, and on its neighbours."""
    random, _order = shuffled(flag.scene(nx=12, ny=8, duration=0.1))
    springs = random.terms[0]
    free = np.setdiff1d(np.arange(96), random.pins.vertices)
    pairs = springs.stencil(random.mesh)
    ends = {vertex: np.intersect1d(pairs[(pairs == vertex).any(axis=1)], free)[0] for vertex in free.tolist()}
    vertex = max(ends, key=ends.get)
    velocities = np.zeros((96, 3))
    velocities[vertex] = 1e38
    stray = replace(random, velocities=velocities, terms=[springs])
    status = wc.simulate(stray, wc.Explicit(substeps=2, above_limit="allow"), device=device).status
    assert status.message == f"diverged in frame 1: vertex {ends[vertex]} is not finite"


@pytest.mark.parametrize(("weights", "energy"), [("clamped", "spokes"), ("cotangent", "spokes_and_rims")])
def test_a_deformation_is_the_same(weights, energy, monkeypatch, device):
    """Its points, rotations and energies, with handles among the vertices; the systems are solved to rounding."""
    random, _order = shuffled(flag.scene(nx=12, ny=8))
    handles = random.mesh.select("x < 0.1 or x > 0.85")
    targets = random.mesh.points[handles] * [1.0, 1.0, 0.8] + [0.0, 0.1, 0.0] * (random.mesh.points[handles, :1] > 0.5)
    found = []
    for least in (1000, 0):
        monkeypatch.setattr(ordering, "MIN_VERTICES", least)
        arap = wc.Arap(random.mesh, handles, weights=weights, energy=energy, device=device)
        found.append(arap.solve(targets, iterations=10, tolerance=0.0))
    for name in ("points", "rotations", "energies"):
        np.testing.assert_allclose(*(getattr(each, name) for each in found), rtol=0, atol=1e-10)


@pytest.fixture
def built(tmp_path, monkeypatch):
    """The models that are built; the scene is in a file sheet.py."""
    models, build = [], wc.Scene.build
    monkeypatch.setattr(wc.Scene, "build", lambda scene, **options: models.append(build(scene, **options)) or models[-1])
    (tmp_path / "sheet.py").write_text(SCENE)
    return models


SCENE = """
import numpy as np
import warpcloth as wc

def scene():
    grid = wc.Mesh.grid(9, 9)
    ranks = np.random.default_rng(4).permutation(81)
    mesh = wc.Mesh(grid.points[np.argsort(ranks)], ranks[grid.triangles])
    return wc.Scene(mesh, density=0.1, terms=[wc.Spring(stiffness=50.0)], pins=[int(ranks[0])], duration=0.1)
"""


def test_the_command_renumbers_the_model_of_explicit_steps_that_it_chooses(tmp_path, always, built, capfd, monkeypatch):
    output = tmp_path / "out.usdc"
    assert main(["run", str(tmp_path / "sheet.py"), "--solver", "explicit", "--json", "-o", str(output)]) == 0
    substeps = json.loads(capfd.readouterr().out)["options"]["substeps"]
    assert built[-1].order is not None
    scene = scene_files.find_source(str(tmp_path / "sheet.py")).scene({})
    monkeypatch.setattr(ordering, "MIN_VERTICES", 1000)
    expected = wc.simulate(scene, wc.Explicit(substeps=substeps)).points
    # Of float32 every step rounds; a tenth of a second of a swing multiplies that by little.
    np.testing.assert_allclose(np.asarray(FrameSequence(output)), expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("solver", ["explicit", "pbd"])
def test_a_benchmark_measures_what_a_run_does(solver, tmp_path, always, built, device):
    scene, setup = asdict(SceneRef(str(tmp_path / "sheet.py"))), asdict(Setup(solver, {"substeps": 64}))
    row = measure(scene, setup, frames=0, device=device, dtype="float32", started=time.time())
    assert row["status"] == "ok"
    assert (built[0].order is not None) == (solver == "explicit")


@pytest.mark.parametrize(
    ("order", "message"),
    [
        (np.arange(34), "order names 34 vertices; it must name each of the 35 once"),
        ([0, 0, *range(1, 34)], "order names vertex 0 twice; each may stand once"),
        (np.arange(1, 36), "order[34] is 35; it must lie in 0 … 34"),
        (np.ones((35, 2)), "order has shape (35, 2) and type float64; it must be a list of whole numbers"),
    ],
    ids=["too few", "twice", "beyond", "no list"],
)
def test_an_order_that_is_none_is_refused(order, message):
    sheet = wc.Scene(wc.Mesh.grid(7, 5), density=0.1, terms=[wc.Spring(stiffness=1.0)])
    with pytest.raises(ValueError) as error:
        sheet.build(order=order)
    assert str(error.value) == message
