"""Friction of cloth with itself: sticking and sliding by Coulomb's law, heat, and what steps pass on."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

import warpcloth as wc
from support.contacts import begin, energy, gradient, pairs_of, slope_of
from support.laws import EXTRA, Sticky
from support.layers import GRAVITY, cloth, ground, positions, rubbing, slope
from support.rows import table
from support.steps import after_frames
from warpcloth.core.hessian import Hessian
from warpcloth.kernels.block_rows import block_rows
from warpcloth.kernels.v_cycle import subtract_product
from warpcloth.scenes import cards

SOLVERS = {
    "explicit": wc.Explicit(substeps=100),
    "newton": wc.Newton(substeps=10, tolerance=1e-6),
    "xpbd": wc.XPBD(substeps=10, iterations=20),
    "projective_dynamics": wc.ProjectiveDynamics(substeps=10, tolerance=1e-4, iterations=100),
    "admm": wc.ADMM(substeps=10, tolerance=1e-4, iterations=100),
    "constrained": wc.ConstrainedDynamics(substeps=10, tolerance=1e-7),
    "xpbd_jacobi": wc.XPBD(substeps=10, iterations=100, sweep="constraint-averaged"),
}


def momenta(stepper):
    """v of the middle of each sheet (layers, 3) [m/s]."""
    mass = stepper.model.scene.vertex_masses[4:].reshape(-1, 9, 1)
    return (mass * stepper.state.v.numpy()[4:].reshape(-1, 9, 3)).sum(axis=1) / mass.sum(axis=1)


def acceleration(scene, solver, device):
    """Of each sheet over frames 3 to 6, of four frames (layers, 3) [m/s²], with nothing cut."""
    stepper = after_frames(scene, solver, 2, device=device, dtype="float64")
    before = momenta(stepper)
    for _ in range(4):
        stepper.frame()
    assert stepper.cut == 0.0
    return 6.0 * (momenta(stepper) - before)


@pytest.mark.host
@table("dtype", ["float32"], ["float64", "float32"])
def test_contact_that_is_gathered_is_what_is_scattered(dtype, device):
    """As on a GPU: the four sums, to the rounding of ten terms, and products as of :mod:`warpcloth.kernels.block_rows`."""
    pairs = pairs_of(rubbing(), device, h=0.01, dtype=dtype)
    pairs.contact.list_corners()
    model = pairs.model
    pairs.launch_begin(model.positions)
    move, p = np.random.default_rng(4).normal(size=(2, model.count, 3))
    pairs.forces.launch(model.array(model.positions.numpy() + 1e-4 * move, model.vec3))
    p = model.array(p, model.vec3)
    diagonal, active = (wp.array(np.arange(each), dtype=wp.int32, device=device) for each in (model.count, 2))
    nothing = wp.zeros(model.count + 1, dtype=wp.int32, device=device)
    policy = wp.full(2, 0.5, dtype=wp.float64, device=device)
    zero, product, near = model.vectors(), model.vectors(), 32.0 * np.finfo(model.numpy_dtype).eps

    def sums(term, scatters):
        term.set_sums(scatters)
        found = [wp.zeros(model.count, dtype=kind, device=device) for kind in (model.vec3, wp.float64, model.mat33, model.vec3)]
        term.add_gradient(found[0])
        term.add_energies(found[1])
        term.add_diagonal(diagonal, found[2], policy)
        term.add_products(p, found[3], active[1:])
        if not scatters:
            rows = block_rows(model.dtype)()
            rows.offsets, rows.pairs, rows.blocks = nothing, term.pairs, term.blocks
            given = [rows, p, None, zero, active[1:], model.count]
            model.launch(subtract_product(model.dtype, 1, 1), (1, model.count), given, [product])
            np.testing.assert_allclose(-product.numpy(), found[3].numpy(), atol=near * np.abs(found[3].numpy()).max())
        return [array.numpy() for array in found]

    for term in pairs.forces.terms:
        for one, other in zip(sums(term, True), sums(term, False), strict=True):
            size = np.abs(one).max()
            assert size > 0.0 and np.abs(one - other).max() < near * size


@pytest.mark.parametrize("size", [1e-5, 1e-3], ids=["sticks", "slides"])
def test_forces_are_the_gradient_and_their_slope_the_hessian(size, device):
    """By central differences with an error of O(η²) of the third derivative; ΣF = 0, and H has no negative eigenvalue."""
    scene, eta, rng = rubbing(), 1e-8, np.random.default_rng(1)
    pairs = pairs_of(scene, device, h=0.01)
    rubs = (pairs.friction.data.limit.numpy() > 0.0).sum()
    assert rubs > 10
    x = scene.positions + size * rng.normal(size=scene.positions.shape) * [1.0, 0.0, 1.0]
    force = gradient(pairs, x, pairs.friction)
    total = np.abs(force).sum()
    assert total > 1e-3 and np.abs(force.sum(axis=0)).max() < 1e-13 * total
    hessian = Hessian(pairs.model, terms=[], dynamic=pairs.forces.terms)
    hessian.assemble(pairs.model.array(x, pairs.model.vec3), 0.0)
    H, friction = (hessian.matrix() + hessian.coupling()).toarray(), pairs.friction.matrix().toarray()
    assert H == pytest.approx(pairs.contact.matrix().toarray() + friction, abs=1e-9 * np.abs(H).max())
    assert np.linalg.eigvalsh(friction).min() > -1e-12 * np.abs(friction).max()

    for _ in range(3):
        direction = rng.normal(size=x.shape)
        change = slope_of(energy, pairs, x, direction, eta, term=pairs.friction, stored=True)
        assert change == pytest.approx((force * direction).sum(), abs=1e-5 * total)
        expected = (friction @ direction.ravel()).reshape(-1, 3)
        found = slope_of(gradient, pairs, x, direction, eta, term=pairs.friction)
        assert found == pytest.approx(expected, abs=1e-5 * np.abs(expected).max())


SLIDING = [("explicit", 1, float, 1e-3), ("newton", 1, Sticky, 1e-3), ("xpbd", 2, float, 5e-3)]
SLIDING += [("midpoint", 1, float, 1e-2), ("bdf2", 1, float, 1e-2)]
SLIDES = dict.fromkeys([*SLIDING, *product(SOLVERS, [1], (float, Sticky), [1e-3]), ("newton", 2, float, 5e-3)])


@table("name, layers, law, error", SLIDING, SLIDES)
def test_slides(name, layers, law, error, device):
    """All sheets have a = g sin θ − μ(g cos θ + a_y), less ke/2ρ if springs bear e more: half of the area is of the ground."""
    solver = SOLVERS[name] if name in SOLVERS else wc.Newton(substeps=10, integrator=name)
    a, angle = acceleration(slope(0.6, law(0.3), layers), solver, device), np.arctan(0.6)
    expected = GRAVITY * np.sin(angle) - 0.3 * (GRAVITY * np.cos(angle) + a[:, 1])
    expected -= (law is Sticky) * 5.0 * GRAVITY / 2e-3 * EXTRA
    assert a[:, 0] == pytest.approx(expected, rel=error)


@table(
    "name, dtype",
    [("newton", "float64"), ("projective_dynamics", "float64"), ("xpbd", "float32")],
    [*product(SOLVERS, ["float64"]), ("newton", "float32"), ("xpbd", "float32")],
)
def test_sticks(name, dtype, device):
    """At tan θ = 0.9 μ implicit steps end at rest; in float32 some coordinates of 0.5 m move by a last place a frame."""
    # Explicit steps swing about there, as nothing damps them: by no more than ε = 0.1 r μ, at a speed of no more than √(k/ρ) ε.
    solver = wc.Newton(substeps=10) if (name, dtype) == ("newton", "float32") else SOLVERS[name]
    stepper = after_frames(slope(0.27), solver, device=device, dtype=dtype)
    start, ends = stepper.state.x.numpy().copy(), list(positions(stepper, 24))
    assert np.abs(ends[-1] - start)[:, [0, 2]].max() < 1e-3
    swings = np.sqrt(10.0 * GRAVITY / 2e-3) * 0.1 * 2e-3 * 0.3
    least = {"explicit": swings, "xpbd_jacobi": 1e-7}.get(name, 1e-9)  # 100 Jacobi sweeps do not quite converge
    creep = np.abs(ends[-1] - ends[-2]).max() * 24.0
    assert creep < (least if dtype == "float64" else 24.0 * np.spacing(np.float32(0.5)) * 1.1)


@table("name", ["xpbd"], SOLVERS)
def test_momentum_and_energy(name, device):
    """Sheets that press and rub: Σp stays, as exactly as linear systems are solved, and motion along them loses energy."""
    scene, left = rubbing(gap=4.5e-3), []
    solver = replace(SOLVERS[name], tolerance=1e-9) if name == "newton" else SOLVERS[name]
    mass = scene.vertex_masses[:, None]
    for friction in (0.0, 0.3):
        declared = replace(scene, self_contact=replace(scene.self_contact, friction=friction))
        stepper = after_frames(declared, solver, steps=10, device=device, dtype="float64")
        v = stepper.state.v.numpy()
        assert stepper.cut == 0.0
        assert np.abs((mass * v).sum(axis=0)).max() < (1e-9 if name == "newton" else 1e-12) * np.abs(mass * v).sum()
        left.append(0.5 * (mass * v[:, [0, 2]] ** 2).sum())
    assert left[1] < 0.99 * left[0]


@table("name", ["xpbd"], ["explicit", "newton", "xpbd"])
def test_energy_becomes_heat(name, device):
    """What a sheet that slides down a slope loses is μ mg cos θ times its way, and it never gains: to 3 % of the heat."""
    # Implicit steps damp 1.8 % at the end. Explicit steps damp nothing: the sheet bounces, so that N is not its weight, by 2.6
    # %, but the heat is all that it loses, to 0.002 in these steps.
    scene = slope(0.6, duration=0.25)
    mass = scene.vertex_masses[4:, None]
    run = wc.simulate(scene, SOLVERS[name], device=device, dtype="float64", record="energies")
    recorded, total = run.energies.pop("heat of friction"), sum(run.energies.values())
    way = (mass * (run.points - run.points[0])[:, 4:])[:, :, 0].sum(axis=1) / mass.sum()
    heat = 0.3 * mass.sum() * GRAVITY * np.cos(np.arctan(0.6)) * way
    assert recorded[0] == 0.0 and (np.diff(recorded) > 0.0).all()
    assert recorded[-1] == pytest.approx(heat[-1], rel=0.03) and (np.diff(total) < 0.0).all()
    assert total[0] - total[-1] == pytest.approx(heat[-1], rel=0.03)
    if name == "explicit":
        assert total[0] - total[-1] == pytest.approx(recorded[-1], rel=0.003)


@pytest.mark.parametrize("axis", "xyz")
def test_turns_with_the_cloth(axis, device):
    """A stretch that is kept turns with both sheets: after a step with a quarter turn, forces are those of before, turned."""
    scene, turn = rubbing(gap=4e-3), Rotation.from_euler(axis, 0.5 * np.pi)
    pairs, found = pairs_of(scene, device, h=0.01), []
    moved = scene.positions + np.where(np.arange(32)[:, None] < 16, 2e-4, 0.0) * [1.0, 0.0, 0.5]
    pairs.friction.launch_end(pairs.model.array(moved, pairs.model.vec3))
    pairs.steps.fill_(1)
    for x in (moved, turn.apply(moved)):
        if found:
            pairs.friction.launch_end(pairs.model.array(x, pairs.model.vec3))
        begin(pairs, x)
        found.append(gradient(pairs, x, pairs.friction))
    assert np.abs(found[0]).max() > 1e-3 and found[1] == pytest.approx(turn.apply(found[0]), abs=1e-12)


@pytest.mark.host
@table("name", ["newton"], ["newton", "xpbd"])
def test_a_plate_that_tilts_carries_what_sticks(name, device):
    """A mesh, by its moves, as a box by its pose, to 1 % of what turns the gap of 4.2 mm by 0.3 rad, which is no slip."""
    frames, sheet = 12, wc.Mesh.grid(5, 5, size=0.25)
    x = sheet.points - sheet.points.mean(axis=0) + [0.02, 4.2e-3, 0.03]
    turn = Rotation.from_euler("z", np.linspace(0.0, 0.3, frames + 1)[:, None])
    pose, slips = {"rotation": turn.as_quat(), "friction": 5.0}, []
    fields = {"bending": 1e-3, "contact": wc.Contact(distance=5e-3, stiffness=1e4), "fps": 24.0}
    solver = wc.Newton(substeps=2) if name == "newton" else wc.XPBD(substeps=2, iterations=100)
    box = wc.Box(size=(0.6, 0.1, 0.6), position=turn.apply([0.0, -0.05, 0.0]), **pose)
    for collider in (ground(0.6, 3, position=np.zeros(3), **pose), box):
        scene = cloth(sheet, positions=x, colliders=[collider], **fields)
        stepper = after_frames(scene, solver, frames, dtype="float64", device=device)
        slips.append((turn[-1].inv().apply(stepper.state.x.numpy()) - x)[:, [0, 2]].mean(axis=0))
    assert slips[0] == pytest.approx(slips[1], abs=0.01 * 4.2e-3 * 0.3) and np.abs(slips[1]).max() < 6e-5


@pytest.mark.parametrize(("name", "friction"), [("xpbd", 0.6), ("xpbd", 0.2), ("newton", 0.35)])
def test_cards(name, friction, device):
    """They stand at an angle of 20° if friction is above (0.97² − cos 40°)/sin 40° = 0.27, and fall within 1.5 s else."""
    scene, stands = cards.scene(friction=friction), friction > 0.27
    stepper = after_frames(scene, SOLVERS[name], 24 if stands else 36, device=device, dtype="float64")
    moved = np.abs(stepper.state.x.numpy() - scene.positions).max()
    assert stepper.cut == 0.0
    assert moved < 1e-3 if stands else moved > 0.05


@pytest.mark.slow  # 1440 frames of two cards
def test_cards_stand_for_a_minute(device):
    """From 30 s on they move by less than 1e-7 m, some last places of coordinates."""
    stepper = after_frames(cards.scene(), SOLVERS["xpbd"], 720, device=device, dtype="float32")
    assert np.ptp(list(positions(stepper, 720)), axis=0).max() < 1e-7
