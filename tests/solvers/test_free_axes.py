"""Tests vertices that move along some axes alone: half a sheet on its plane of symmetry, one minimum, rails, pins."""

from dataclasses import replace

import numpy as np
import pytest

import warpcloth as wc
from support import setups
from support.rows import table
from support.setups import MAIN, square
from support.steps import after_steps, newton_step, spring, swinging

# Eight substeps, for Explicit is not stable with fewer.
SOLVERS = {name: replace(solver, substeps=8) for name, solver in setups.SOLVERS.items()}
LOCKING = {name: solver for name, solver in SOLVERS.items() if solver.locks}
N = 9  # vertices a side; odd, so that the cloth has a middle column


def halves():
    """A sheet that is pulled together along x, the indices of its half x ≤ 0, and that half by itself."""
    # Springs along the cut have half the stiffness, lumped masses half the mass, and vertices there do not move along x.
    grid = wc.Mesh.grid(N, N, pattern="alternating")
    mesh = wc.Mesh(grid.points - grid.points.mean(axis=0), triangles=grid.triangles)
    x = mesh.points[:, 0]
    velocities = np.stack([-2.0 * x, 1.0 + np.abs(x), 0.0 * x], axis=1)
    given = {"density": 0.1, "gravity": (0.0, -9.81, 1.0)}
    whole = wc.Scene(mesh, terms=[wc.Spring(stiffness=100.0)], pins=[0, N - 1], velocities=velocities, **given)
    kept, index = np.flatnonzero(x < 1e-9), np.full(len(x), -1)
    index[kept] = np.arange(len(kept))
    triangles = index[mesh.triangles]
    part = wc.Mesh(mesh.points[kept], triangles=triangles[(triangles >= 0).all(axis=1)])
    cut = x[kept] > -1e-9
    stiffness, free = np.where(cut[part.edges].all(axis=1), 50.0, 100.0), np.ones((len(kept), 3), dtype=bool)
    free[cut, 0] = False
    given |= {"velocities": velocities[kept], "free_axes": free}
    return whole, kept, wc.Scene(part, terms=[wc.Spring(stiffness=stiffness)], pins=[0], **given)


def rails(declared, seed=0):
    """A scene of which a third of the coordinates is locked."""
    free = np.random.default_rng(seed).random((len(declared.mesh.points), 3)) > 0.3
    return replace(declared, free_axes=free)


# Local steps depend on the masses of the cut, which are half; where they have ended they agree.
ENDED = {
    name: replace(solver, iterations=5_000, tolerance=1e-11) if hasattr(solver, "tolerance") else solver
    for name, solver in LOCKING.items()
    if not isinstance(solver, (wc.PBD, wc.HierarchicalPBD)) and "scalar" not in repr(solver) and "'none'" not in repr(solver)
} | {f"xpbd {sweep}": wc.XPBD(substeps=8, iterations=400, sweep=sweep) for sweep in ("coloured", "constraint-averaged")}
del ENDED["xpbd"], ENDED["xpbd averaged by constraint"]


@table("name", ("explicit", "newton", "admm"), ENDED)
def test_half_a_sheet_moves_as_the_whole(name, device):
    """To 1e-9 m, within which steps end; without the lock the half moves by centimetres from there."""
    whole, kept, half = halves()
    run = {"device": device, "dtype": "float64", "frames": 2 if name == "newton" else 1}
    ends = [wc.simulate(each, ENDED[name], **run).points[-1] for each in (whole, half)]
    assert np.abs(ends[1] - ends[0][kept]).max() < 1e-9
    if name == "newton":
        unlocked = wc.simulate(replace(half, free_axes=None), ENDED[name], **run).points[-1]
        assert np.abs(unlocked - ends[0][kept]).max() > 1e-2


def test_half_a_sheet_hangs_as_the_whole(device):
    whole, kept, half = halves()
    rest = [wc.equilibrium(each, device=device) for each in (whole, half)]
    assert rest[0].stable and rest[1].stable and np.abs(rest[1].points - rest[0].points[kept]).max() < 1e-7
    assert np.abs(rest[0].points - whole.positions).max() > 0.1


NEWTON, PD = wc.Newton(substeps=1, tolerance=1e-11), wc.ProjectiveDynamics(substeps=1, tolerance=1e-11, iterations=5_000)
MINIMISE = {
    "newton": NEWTON,
    "projective dynamics": PD,
    "projective dynamics matrix-free": replace(PD, acceleration="l-bfgs", linear="jacobi"),
    "admm": wc.ADMM(substeps=1, tolerance=1e-11, iterations=5_000),
    "constrained dynamics": wc.ConstrainedDynamics(substeps=1, tolerance=1e-12, iterations=200),
    "constrained dynamics factorised": wc.ConstrainedDynamics(substeps=1, tolerance=1e-12, iterations=200, linear="factorised"),
    "xpbd": wc.XPBD(substeps=1, iterations=15_000),
}


def membrane():
    """A membrane with a soft body, a strain limit and an attachment, in motion."""
    mesh = wc.Mesh.grid(5, 5, pattern="alternating")
    terms = [
        wc.CorotatedMembrane(stiffness=30.0),
        wc.StrainLimit(most=1.01, stiffness=100.0),
        wc.QuadraticBending(stiffness=1e-4),
        wc.Attachment(vertices=[24], stiffness=10.0, targets=[[1.1, 0.1, 1.0]]),
        wc.RigidCluster(vertices=[[6, 7, 11, 12]], stiffness=50.0),
    ]
    velocities = np.random.default_rng(1).normal(scale=2.0, size=(25, 3))
    return wc.Scene(mesh, density=0.1, terms=terms, pins=[0], velocities=velocities)


@table(
    "name, scene",
    [("newton", "springs"), ("constrained dynamics", "springs"), ("admm", "springs")],
    [(name, scene) for name in MINIMISE for scene in ("springs", "membrane")],
)
def test_all_meet(name, scene, device):
    """At the minimum over the coordinates that are free, where the gradient along them is 0."""
    # ADMM does not take bodies; constrained dynamics converges slowly where a limit turns, without locks too.
    declared = rails(replace(swinging(8), fps=120.0) if scene == "springs" else membrane())
    left_out = {wc.ADMM: wc.RigidCluster, wc.ConstrainedDynamics: wc.StrainLimit}.get(type(MINIMISE[name]), ())
    declared = replace(declared, terms=[term for term in declared.terms if not isinstance(term, left_out)])
    newton = newton_step(declared, device)
    x, stepper = after_steps(declared, MINIMISE[name], device)
    assert np.abs(x - newton).max() < 1e-8 and stepper.residual[0] < 1e-6
    if name == "newton":  # which says for all that the locks matter
        assert np.abs(newton_step(replace(declared, free_axes=None), device) - newton).max() > 1e-3


RAIL = {"free_axes": [[True] * 3, [False, True, False]], "gravity": (0.0, -9.81, 0.0)}
PROJECT = {name: solver for name, solver in LOCKING.items() if isinstance(solver, (wc.PBD, wc.HierarchicalPBD, wc.XPBD))}


@pytest.mark.parametrize("name", PROJECT)
def test_a_hard_spring_holds_a_bead_on_its_rail(name, device):
    """Of length 1, from the origin to (0.6, y): y ends at −0.8, by corrections that shrink by 1 − y² or more in a sweep."""
    x, _ = after_steps(spring((0.6, -0.7, 0.0), np.inf, **RAIL), replace(PROJECT[name], iterations=100), device)
    np.testing.assert_allclose(x[1], [0.6, -0.8, 0.0], rtol=0.0, atol=1e-9)


@table("name", ("newton", "xpbd"), MAIN)
def test_vertices_without_a_free_axis_are_pins(name, device):
    """To the bit, and to every solver."""
    declared, free = square(solver=SOLVERS[name]), np.repeat(np.arange(36)[:, None] != 5, 3, axis=1)
    scenes = replace(declared, pins=[0, 5]), replace(declared, pins=[0], free_axes=free)
    runs = [wc.simulate(each, SOLVERS[name], device=device, frames=4).points[-1] for each in scenes]
    assert (runs[0] == runs[1]).all()


@table("name", ("newton", "xpbd", "admm"), [name for name in LOCKING if "factorised" not in name])
def test_locked_coordinates_stay_to_the_bit(name, device):
    """In float32, in a batch, in another order, along gravity and after a reset to other positions, with a velocity of 0."""
    declared = replace(rails(square(solver=SOLVERS[name], pins=[0])), velocities=np.ones((36, 3)))
    declared = replace(declared, terms=declared.terms[:2])  # test_pins_hold_their_axes has hinges
    model = declared.build(device=device, copies=2, order=np.arange(36)[::-1], vary={"Spring.stiffness": [50.0, 100.0]})
    stepper, locked = SOLVERS[name].bind(model), np.tile(declared.locked, (2, 1))
    assert locked[:, 1].any()

    def run(frames):
        for _ in range(frames):
            stepper.frame()
        return (model.in_scene_order(array.numpy()) for array in stepper.state)

    x, v = run(5)
    start = model.in_scene_order(model.positions.numpy())
    assert (x[locked] == start[locked]).all() and (v[locked] == 0.0).all()
    assert (np.abs(x - start)[~locked].reshape(2, -1).max(axis=1) > 1e-3).all()
    if "bdf2" not in name:
        moved = start.reshape(2, 36, 3)[:, ::-1] + np.float32(0.1)
        stepper.reset(positions=moved, velocities=np.ones((2, 36, 3)))
        x, v = run(2)
        moved, pinned = model.in_scene_order(moved.reshape(-1, 3)), np.isin(np.arange(72) % 36, declared.fixed)
        assert (x[locked] == moved[locked]).all() and (v[locked] == 0.0).all()
        assert np.isfinite(x).all() and (v[~locked & ~pinned[:, None]] != 0.0).all()


def rollers(solver=None, frames=9, **given):
    """A square whose corners of the side z = 0 are clamped, led along x alone, and may not leave the plane z = 0 in turns."""
    declared, vertices = square(solver=solver, **given), [0, 5, 2, 3]
    keyframes = np.repeat(declared.positions[vertices][None], frames, axis=0)
    rise = 0.05 * (1.0 - np.cos(0.7 * np.arange(frames)))
    keyframes += rise[:, None, None] * np.array([1.0, 0.3, 0.2])
    return replace(declared, pins=wc.Pins(vertices, keyframes, axes=["xyz", "x", "zy", "z"]))


@table("name", ("newton midpoint", "xpbd"), [*MAIN, "newton midpoint", "newton bdf2"])
def test_pins_hold_their_axes(name, device):
    """Along them they are where the keyframes say and as fast, and along the others the cloth takes them where it goes."""
    declared, solver = rollers(LOCKING[name]), LOCKING[name]
    run, held = wc.simulate(declared, solver, device=device, dtype="float64", frames=6), declared.pins.held
    assert held.tolist() == [[True] * 3, [True, False, False], [False, True, True], [False, False, True]]
    vertices, keyframes = declared.pins.vertices, declared.pins.keyframes
    speeds = np.diff(keyframes, axis=0)[:6] * declared.fps
    np.testing.assert_allclose(run.points[:, vertices][:, held], keyframes[:7, held], rtol=0.0, atol=1e-15)
    np.testing.assert_allclose(run.velocities[1:, vertices][:, held], speeds[:, held], rtol=0.0, atol=1e-12)
    assert np.abs(run.points[6, vertices] - keyframes[6])[~held].min() > 1e-4


@table("name", ("newton", "xpbd"), ["explicit", "newton", "newton midpoint", "newton bdf2", "xpbd", "admm"])
def test_pins_that_hold_axes_are_rails_and_moved_pins(name, device):
    """Standing ones are free_axes; one whose other axes are locked is a pin that holds all of them."""
    declared, free = square(solver=LOCKING[name], damping=1e-3), np.ones((36, 3), dtype=bool)
    free[[5, 7]] = [True, False, True]
    still = [replace(declared, pins=wc.Pins([5, 7], axes="y")), replace(declared, free_axes=free)]
    moved = rollers(LOCKING[name])
    keyframes = moved.pins.keyframes.copy()
    keyframes[..., 1:] = keyframes[:1, :, 1:]
    free[moved.pins.vertices] = [True, False, False]
    moved = replace(moved, terms=declared.terms)
    led = [
        replace(moved, pins=wc.Pins(moved.pins.vertices, keyframes)),
        replace(moved, pins=wc.Pins(moved.pins.vertices, keyframes, axes="x"), free_axes=free),
    ]
    led[0] = replace(led[0], free_axes=np.where(np.isin(np.arange(36), [5, 7])[:, None], [True, False, True], True))
    run = {"device": device, "dtype": "float64", "frames": 5}
    for pair in (still, led):
        ends = [wc.simulate(each, LOCKING[name], **run).points[-1] for each in pair]
        np.testing.assert_allclose(ends[1], ends[0], rtol=0.0, atol=1e-13)


def test_a_symmetric_half_is_pinned_by_its_normal(device):
    """As pins of the plane's vertices along x, which is how rollers are written."""
    _whole, _kept, half = halves()
    pinned = wc.Pins(np.r_[0, np.flatnonzero(~half.free_axes[:, 0])], axes=["xyz", *["x"] * (~half.free_axes[:, 0]).sum()])
    ends = [wc.equilibrium(each, device=device).points for each in (half, replace(half, free_axes=None, pins=pinned))]
    np.testing.assert_array_equal(ends[1], ends[0])


@pytest.mark.host
@pytest.mark.parametrize(
    ("axes", "sentence"),
    [
        ("w", "pins.axes is 'w'; it must be some of the letters x, y and z, each once, such as 'xz'"),
        ("", "pins.axes is ''; it must be some"),
        ("xx", "pins.axes is 'xx'; it must be some"),
        (3, "pins.axes[0] is 3; it must be some"),
        (["x", "q"], "pins.axes[1] is 'q'; it must be some"),
        (["x"], "pins.axes has 1 texts for 2 pins; it must be one text, or one for each pin"),
    ],
)
def test_bad_axes_of_pins_are_refused(axes, sentence):
    with pytest.raises(ValueError) as found:
        square(pins=wc.Pins([0, 1], axes=axes))
    assert sentence in str(found.value)


@pytest.mark.host
def test_handles_hold_all_axes():
    mesh = wc.Mesh.grid(3, 3)
    with pytest.raises(ValueError, match=r"^pins\.axes leaves some axes of a handle free; deform takes handles that hold all"):
        wc.deform(mesh, wc.Pins([0], keyframes=[mesh.points[[0]]], axes="x"))


def test_a_bead_on_a_rail_comes_to_rest(device):
    """Its spring of length 1 goes from the origin to (1, y): k(1 − 1/l)y = −mg with l² = 1 + y²; U″ = k(1 − 1/l³)."""
    for linear in ("factorised", "cg"):
        rest = wc.equilibrium(spring((1.0, -0.1, 0.0), **RAIL), device=device, linear=linear)
        x, y, z = rest.points[1]
        length = np.hypot(1.0, y)
        assert (x, z) == (1.0, 0.0) and 100.0 * (1.0 - 1.0 / length) * y == pytest.approx(-9.81, rel=1e-7)
        assert rest.lowest_eigenvalue == pytest.approx(100.0 * (1.0 - length**-3), rel=1e-6) and rest.stable


@table("name", [name for name in MAIN if name != "explicit"], LOCKING)
def test_without_locks_nothing_is_there(name, device):
    """No bytes, kernels or launches more where every axis is free."""
    found = []
    for free_axes in (None, np.ones((36, 3), dtype=bool)):
        model = square(solver=SOLVERS[name], free_axes=free_axes).build(device=device)
        SOLVERS[name].bind(model).step()
        found.append((model.report(), model.launches[0]))
    assert model.mobility is None and found[0] == found[1]


@pytest.mark.host
def test_who_cannot_refuses():
    class Rigid(wc.Newton):
        locks = False

    able = "Explicit, Newton, .* or .*"
    with pytest.raises(ValueError, match=f"^Rigid cannot take a vertex that is locked along some axes, .*; {able} can$"):
        Rigid(substeps=1).bind(rails(square()).build())


@pytest.mark.host
def test_bad_masks_are_refused():
    rule = r"it must be an array \(36, 3\) of truth values, one for each axis of each vertex$"
    shape, numbers, ragged = np.ones((35, 3), dtype=bool), np.ones((36, 3)), [[True], [True, False]]
    sentences = r"has shape \(35, 3\)", r"is array\(.*", r"is \[\[True\], \[True, False\]\]", "is 'x'"
    for free_axes, sentence in zip((shape, numbers, ragged, "x"), sentences, strict=True):
        with pytest.raises(ValueError, match=f"^free_axes {sentence}; {rule}"):
            square(free_axes=free_axes)
    with pytest.raises(ValueError, match="vertex 0 has mass 0"):
        rails(wc.Scene(wc.Mesh.chain(2), masses=[0.0, 1.0], terms=[wc.Spring(stiffness=1.0)]), seed=3)


@pytest.mark.host
def test_a_scene_says_what_it_locks():
    free = np.ones((36, 3), dtype=bool)
    free[[3, 4, 5], 0] = False
    free[7] = False
    assert "  locked coordinates: 3 x, 0 y, 0 z\n" in str(square(free_axes=free)) and "locked" not in str(square())
