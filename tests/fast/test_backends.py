"""Every backend against the core, the core against NumPy, and frames against steps, to the bit."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import warp as wp

import warpcloth as wc
from support.energies import damping_forces
from support.layers import positions
from support.rows import slow_but, table
from support.setups import SOLVERS
from support.sheets import SPRINGS, TERMS, N, declared
from warpcloth.core.gradient import Gradient
from warpcloth.core.status import Result
from warpcloth.fast import block_layout, gather_layout, gather_step
from warpcloth.fast.block_layout import block_layout as layout_of
from warpcloth.fast.gather_layout import gathered
from warpcloth.fast.plan import plan
from warpcloth.model.damping import damped_terms
from warpcloth.numerics.sweeps import JacobiSweep
from warpcloth.solvers import solver
from warpcloth.solvers.explicit import ExplicitStepper, limit_in_motion
from warpcloth.terms.refresh import STEP, Moment


def apart(model, stepper, scheme, steps):
    """x and v after so many steps, forces by the kernels of one term each and the rest in NumPy."""
    scene, h = model.scene, stepper.h
    forces, gradient = Gradient(model), model.vectors()
    x, v = (array.numpy().astype(np.float64) for array in (model.positions, model.velocities))
    inverse = model.inverse_mass.numpy().astype(np.float64)[:, None]
    gravity = np.repeat(model.gravity.numpy(), model.per_copy, axis=0)
    for step in range(1, steps + 1):
        gradient.zero_()
        place = model.array(x, model.vec3)
        forces.add(place, gradient)
        a = gravity - inverse * (gradient.numpy() + damping_forces(model, h, place, v))
        a = np.where(inverse > 0.0, a, 0.0)
        before, v = v, v + h * a
        move = h * (v if scheme == "symplectic" else before)
        x = x + np.where(inverse > 0.0, move, 0.0)
        frame, part = divmod(step / stepper.steps_per_frame, 1.0)
        keyframes = scene.pins.keyframes
        frames = np.minimum([int(frame), int(frame) + 1], len(keyframes) - 1)
        place = (1.0 - part) * keyframes[frames[0]] + part * keyframes[frames[1]]
        for first in range(0, model.count, model.per_copy):
            i = first + scene.pins.vertices
            x[i], v[i] = place, (place - x[i]) / h
    return x, v


# Each on the CPU, which runs what is for CUDA too.
BACKENDS = ["core", "blocks", "small blocks", "gather"]


@pytest.fixture
def backend(request, device, monkeypatch):
    """The name of a backend that the device has."""
    name = request.param
    if name == "small blocks":  # of which the sheet has several, with runs of few elements
        monkeypatch.setattr(block_layout, "NUMBERS", 60)
        monkeypatch.setattr(block_layout, "RUN", 3)
        name = "blocks"
    if name == "blocks" and not wp.get_device(device).is_cpu:
        pytest.skip("blocks are for the CPU")
    return name


# Of each number of vertices and of rows, with and without damping, which hinges have with several rows; "several" has what
# else there is of springs, bending and bodies. The membranes differ in their energies alone, which all backends take from one
# function, as test_terms.py does.
BACKWARDS = "springs, the higher vertex first, each of its own stiffness"
MOVED = ["nothing", "springs", BACKWARDS, "limits", "quadratic bending", "plate bending", "dihedral bending", "several"]
# A kernel of a backend is compiled for its terms, options and precision, which takes most of the time of its tests. In float32
# that of "several" is for CUDA, where the compiler may round it otherwise; the loops of the CPU are the same in both.
STEPS = [
    *((name, "float64", "symplectic", backend) for name in MOVED for backend in BACKENDS),
    *(("springs", "float32", "symplectic", backend) for backend in BACKENDS),
    ("several", "float32", "symplectic", "gather"),
    *(("springs", "float64", "forward", backend) for backend in BACKENDS),
]


QUICK = [("nothing", "float64", "symplectic"), ("springs", "float32", "symplectic"), ("springs", "float64", "forward")]
QUICK_STEPS = slow_but([(*row, backend) for row in QUICK for backend in BACKENDS], STEPS)


@pytest.mark.parametrize(("name", "dtype", "scheme", "backend"), QUICK_STEPS, indirect=["backend"])
def test_explicit_steps_are_those_of_the_core(name, backend, scheme, dtype, device):
    """And those of the core are forces, and the update in NumPy."""
    vary, steps = {"gravity": [[0.0, -9.81, 0.0], [1.0, 2.0, 3.0]]}, 5
    model = declared(TERMS[name], fps=250.0).build(device=device, dtype=dtype, copies=2, vary=vary)
    options = wc.Explicit(substeps=4, scheme=scheme, above_limit="allow")
    stepper, core = (ExplicitStepper(options, model, each) for each in (backend, "core"))
    assert stepper.h <= limit_in_motion(model) and stepper.plan.record.backend == backend
    for each in (stepper, core):
        for _ in range(steps):
            each.step()
    x, v = (array.numpy() for array in stepper.state)
    expected = apart(model, core, scheme, steps) if backend == "core" else [array.numpy() for array in core.state]
    # Below the limit h²k/m + 2hc/m ≤ 4, so that a few roundings of positions and moves of size 1, 16 of them here, change v by
    # no more than 16·4ε/h a step.
    tolerance = steps * 64 * np.finfo(dtype).eps / stepper.h
    assert np.abs(v - expected[1]).max() < tolerance
    assert np.abs(x - expected[0]).max() < steps * stepper.h * tolerance


def draped(moving):
    """A sheet that slides off a ball onto a floor, or off a ball that moves and a box that turns."""
    center = np.array([0.5, -0.301, 0.5]) + 0.01 * np.arange(9 if moving else 1)[:, None] * [1.0, 0.0, 0.0]
    ball = wc.Sphere(radius=0.3, position=center, friction=0.3)
    turns = [(0.0, 0.0, np.sin(0.02 * k), np.cos(0.02 * k)) for k in range(9)]
    box = wc.Box(size=(0.2, 0.1, 0.2), position=(0.2, -0.2, 0.2), rotation=turns, friction=0.2)
    mesh, other = wc.Mesh.grid(7, 7), box if moving else wc.Plane(position=(0.0, -0.05, 0.0))
    fields = {"velocities": np.tile([0.3, -1.0, 0.0], (49, 1)), "fps": 24.0, "duration": 1.0}
    fields |= {"colliders": [ball, other], "contact": wc.Contact(distance=1e-3, stiffness=1.5e4)}
    return wc.Scene(mesh, density=0.15, terms=[replace(SPRINGS, damping=0.01)], **fields)


@table("moving", [True], [False, True])
@pytest.mark.parametrize("backend", slow_but(["gather"], ["blocks", "gather"]), indirect=True)
def test_contact_in_explicit_steps_is_that_of_the_core(moving, backend, device):
    """Anchors of friction and cuts too; also where positions are set in between. To follow contact changes no bit, and
    has terms of contact as the core has them.
    """
    model = draped(moving).build(device=device, dtype="float64", copies=2)
    steppers = [ExplicitStepper(wc.Explicit(substeps=60), model, each) for each in (backend, "core", backend)]
    steppers[2].follow_contact()
    assert [stepper.plan.guard is None for stepper in steppers] == [False, True, False]
    for _ in range(2):
        for _ in range(3):
            steppers[0].frame()
            steppers[1].frame()
            for _ in range(60):
                steppers[2].step()
        one, core, followed = (stepper.state.to_host() for stepper in steppers)
        assert core["vertices cut short"].all() and (core["anchors on collider 0"][:, 3] > 0.0).any()
        assert all(np.array_equal(one[name], followed[name]) for name in one)
        for name in ("vertices cut short", "steps of colliders"):
            assert np.array_equal(one[name], core[name])
        # Contact of 1.5e4 Pa/m and friction multiply rounding by some 1e4 in these 180 steps.
        assert np.abs(one["x"] - core["x"]).max() < 1e-10
        assert np.abs(one["anchors on collider 0"] - core["anchors on collider 0"])[:, 3].max() < 1e-10
        for followed_, expected in zip(steppers[2].model.terms, steppers[1].model.terms, strict=True):
            if expected.collider is not None:
                np.testing.assert_allclose(followed_.rest.numpy(), expected.rest.numpy(), rtol=0.0, atol=1e-10)
        for stepper in steppers:
            stepper.reset()
            stepper.state.x.assign(model.positions.numpy() + np.array([0.05, 1e-4, 0.05]))


def record(scene, device, backend="auto", dtype="float32"):
    """How explicit steps of a scene are taken."""
    model = scene.build(device=device, dtype=dtype)
    return ExplicitStepper(wc.Explicit(substeps=500, above_limit="allow"), model, backend).plan.record


BENDING = wc.QuadraticBending(stiffness=1e-3)
HINGE = wc.Scene(wc.Mesh.grid(2, 2), density=0.1, terms=[BENDING])


@pytest.mark.parametrize(
    ("scene", "pairs"),
    [
        (declared([SPRINGS, BENDING]), ("QuadraticBending",)),
        (declared([replace(BENDING, name="folds")]), ("folds",)),
        pytest.param(declared(TERMS["damped quadratic bending"]), (), marks=pytest.mark.slow),
        pytest.param(declared(TERMS["dihedral bending"]), (), marks=pytest.mark.slow),
        (HINGE, ()),  # whose six pairs are slower than itself
        (declared([]), ()),
    ],
)
def test_quadratic_terms_are_pairs_where_these_are_faster(scene, pairs):
    assert record(scene, "cpu", "blocks", dtype="float64").pairs == pairs  # most of whose kernels tests above have


def test_the_plan_takes_the_fast_backend_of_the_device(device):
    scene, cpu = declared([SPRINGS, BENDING]), wp.get_device(device).is_cpu
    found = record(scene, device)
    assert plan(scene.build(device=device)).backend == found.backend == ("blocks" if cpu else "gather")
    assert (found.lanes, found.block, found.compensated) == (1 if cpu else 4, 0, False)
    assert found.pairs == record(scene, device, "gather").pairs == ("QuadraticBending",)
    assert record(scene, device, "core") == found._replace(backend="core", lanes=1, pairs=())


# Every way in which gradients store incidences, by what a term is: none, pairs that share a stiffness, elements, and in
# "several" these and pairs of their own stiffness one after another; test_gathering_is_scattering has each by itself.
GRADIENTS = [
    *((name, dtype) for name in ("nothing", "springs") for dtype in ("float32", "float64")),
    ("plate bending", "float64"),
    ("several", "float64"),
]


@table("name, dtype", [(name, "float32") for name in ("nothing", "springs")], GRADIENTS)
def test_gradients_are_those_of_the_core(name, dtype, device):
    """At x, and at x + d."""
    model = declared(TERMS[name]).build(device=device, dtype=dtype)
    d, found = model.array(np.random.default_rng(6).normal(scale=0.01, size=(N, 3)), model.vec3), {}
    for backend in ("core", "gather"):
        out = model.vectors(), model.vectors()
        plan(model, backend).gradient().add(model.positions, out[0])
        plan(model, backend).gradient(corrected=True).add(model.positions, out[1], d)
        found[backend] = np.array([each.numpy() for each in out])
    assert found["core"].any() or name == "nothing"
    # A vertex has at most 24 elements here, whose forces are k times what a few roundings of positions of size 1 change.
    size = 24 * 8 * max(np.abs(found["core"]).max(), *(elements.stiffness.numpy().max() for elements in model.terms), 0.0)
    assert np.abs(found["gather"] - found["core"]).max() <= np.finfo(dtype).eps * size


def test_a_backend_that_is_not_there_is_refused():
    with pytest.raises(ValueError, match="backend is 'fastest'"):
        record(declared([]), "cpu", "fastest")


@table("dtype", ["float32"], ["float32", "float64"])
@pytest.mark.parametrize("backend", ["core", "blocks", "gather"], indirect=True)
def test_a_soft_crease_joins_stiff_parts(backend, dtype, device):
    """What is left out of a matrix is not what is small beside all else at its vertices: the torque that unfolds is there."""
    sheet, eps = wc.Mesh.grid(9, 9), float(np.finfo(dtype).eps)
    x, _y, z = sheet.points.T
    mean = x.mean()
    far = x > mean
    folded = np.column_stack([np.where(far, mean, x), np.where(far, x - mean, 0.0), z])
    crease = (np.abs(x[wc.QuadraticBending(stiffness=1.0).stencil(sheet)[:, :2]] - mean) < 1e-9).all(axis=1)
    torques = []
    for stiff in (0.0, 64.0 / eps):
        terms = [wc.QuadraticBending(stiffness=np.where(crease, 1.0, stiff))]
        scene = wc.Scene(sheet, density=1.0, terms=terms, positions=folded, gravity=[0.0, 0.0, 0.0], fps=100.0, duration=1.0)
        options, model = wc.Explicit(substeps=1, above_limit="allow"), scene.build(device=device, dtype=dtype)
        stepper = ExplicitStepper(options, model, backend)
        stepper.step()
        momenta = scene.vertex_masses[far, None] * stepper.state.v.numpy()[far]
        torques.append(np.cross(folded[far] - [mean, 0.0, 0.0], momenta)[:, 2].sum())
    # Forces of the stiff parts are rounding, 64 in all, along lines through the crease but for ε of them.
    assert torques[0] and torques[1] == pytest.approx(torques[0], rel=1024.0 * eps)


PAIRS = ("nothing", "springs", BACKWARDS, "damped springs")


@table("name, dtype", [(name, "float32") for name in PAIRS], [*((name, "float32") for name in PAIRS), ("springs", "float64")])
def test_steps_of_one_launch_are_steps(name, dtype, device, monkeypatch):
    """Of CUDA, but right on the CPU too: an even number and an odd one, of the CPU to the bit those of a launch each."""
    monkeypatch.setattr(gather_layout, "LANED", 0)  # as of many copies
    vary = {"gravity": [[0.0, -9.81, 0.0], [1.0, 2.0, 3.0], [0.0, 0.0, 0.0]]}
    model = declared(TERMS[name], pins=[0, 6], fps=250.0).build(device=device, dtype=dtype, copies=3, vary=vary)
    states, launches = [], []
    for sizes in ([4, 5], [1] * 9):
        stepper = ExplicitStepper(wc.Explicit(substeps=4, above_limit="allow"), model, "gather")
        before = model.launches[0]
        for steps in sizes:
            stepper.launch_steps(steps)
        launches.append(model.launches[0] - before)
        states.append([array.numpy() for array in stepper.state])
        monkeypatch.setattr(gather_step, "block_of", lambda model, parts: 0)
    assert launches == [2, 9]
    # Compilers of GPUs contract the products of the two kernels as each allows: a few roundings a step, as above.
    tolerance = 9 * 64 * np.finfo(dtype).eps / stepper.h if model.device.is_cuda else 0.0
    assert np.abs(np.array(states[0]) - states[1]).max() <= tolerance


@pytest.mark.parametrize(
    ("scene", "one"),
    [
        (declared([SPRINGS], pins=[0, 6]), True),
        (declared([SPRINGS]), False),  # whose pins are led
        (declared([SPRINGS, wc.QuadraticBending(stiffness=1e-3)], pins=None), False),
        (declared(TERMS["clusters"], pins=None), False),
        (wc.Scene(wc.Mesh.grid(33, 33), density=0.1, terms=[SPRINGS], duration=1.0), False),
    ],
)
def test_which_copies_are_blocks(scene, one, device, monkeypatch):
    assert wp.get_device(device).is_cpu or not record(scene, device, "gather").block
    monkeypatch.setattr(gather_layout, "LANED", 0)
    assert bool(record(scene, device, "gather").block) == one


LAUNCHED = [name for name, made in SOLVERS.items() if isinstance(made, (wc.Explicit, wc.PBD, wc.HierarchicalPBD, wc.XPBD))]


@table("launches", [10], [1, 10, 10_000])
@pytest.mark.parametrize("name", [*LAUNCHED, "xpbd midpoint", "newton"])
def test_frames_are_steps_to_the_bit(name, launches, device, monkeypatch):
    """In graphs of one step, of some with some over, and of all; with pins that move, a counter of their own, and damping."""
    monkeypatch.setattr(solver, "LAUNCHES", launches)
    record = wc.XPBD(substeps=1, iterations=4, integrator="midpoint") if name == "xpbd midpoint" else SOLVERS[name]
    record = replace(record, substeps=7)
    scene = declared([replace(SPRINGS, damping=0.01), wc.QuadraticBending(stiffness=1e-4)], fps=60.0)
    steppers = [record.bind(scene.build(device=device, copies=2, vary={"Spring.stiffness": [50.0, 100.0]})) for _ in range(2)]
    for _ in range(3):
        steppers[0].frame()
        for _ in range(7):
            steppers[1].step()
    for one, other in zip(*(stepper.state for stepper in steppers), strict=True):
        assert np.array_equal(one.numpy(), other.numpy())
    assert np.array_equal(steppers[0].residual, steppers[1].residual) and steppers[0].results == steppers[1].results


SWEEPS = {
    "plain": {"kind": "jacobi"},
    "averaged by vertex": {"kind": "vertex-averaged", "alpha": 1.0},
    "averaged by constraint": {"kind": "constraint-averaged"},
    "stiffness per step": {"kind": "vertex-averaged", "spread": 4},
    "multipliers": {"kind": "constraint-averaged", "multipliers": True},
    "scalar constraints": {"kind": "constraint-averaged", "multipliers": True, "scalar": True},
}
PROJECTED = TERMS | {"corotated": [wc.CorotatedMembrane(stiffness=100.0)]}
PROJECTED["orthotropic"] = [replace(TERMS["orthotropic"][0], damping=0.0)]
# All that sweeps do to corrections, for pairs; each kind of correction (to a projection, by a prox, by a Newton step, of a
# scalar) and, one after another in "several", each number of vertices and of rows and damping, with and without λ. The energy
# is in none of that: its correction is one function of all backends, which test_terms.py has by itself.
SWEPT = [
    *(("springs", "float64", options) for options in SWEEPS),
    *(("springs", "float32", options) for options in ("plain", "multipliers")),
    *((name, "float64", "plain") for name in ("nothing", BACKWARDS, "limits", "corotated", "dihedral bending", "several")),
    *((name, "float64", "multipliers") for name in ("nothing", "limits", "orthotropic", "several")),
    ("limits", "float64", "stiffness per step"),
    ("several", "float64", "averaged by constraint"),
    ("several", "float32", "plain"),  # for CUDA, where the compiler may round it otherwise
]


@table("name, dtype, options", [("limits", "float64", "plain"), ("springs", "float32", "plain")], SWEPT)
def test_jacobi_sweeps_are_those_of_the_core(name, dtype, options, device):
    """d and λ, whether sweeps run one by one, which copies what they leave in other arrays back, or in pairs."""
    options = SWEEPS[options]
    scene, steps, h, found = declared(PROJECTED[name]), 3, 0.02, {}
    moves = np.random.default_rng(7).normal(scale=0.01, size=(2 * N, 3))
    for backend, pairs in (("core", False), ("blocks", False), ("gather", False), ("gather", True)):
        # Scattering is for one thread, of the CPU.
        model = scene.build(device="cpu" if backend == "blocks" else device, dtype=dtype, copies=2)
        model = model.with_terms(damped_terms(model, h))
        model.refresh(STEP, Moment(model.positions))  # sets the rest state of what is damped, by element
        d = model.array(moves, model.vec3)
        made = JacobiSweep(model, model.positions, h, relaxation=0.1, backend=backend, **options)
        made.correction.assign(d)
        made.launch_start()
        assert not made.correction.numpy().any()
        made.correction.assign(d)
        for launch, times in made.parts(steps) if pairs else [(made.launch, steps)]:
            for _ in range(times):
                launch()
        found[backend, pairs] = [made.correction.numpy(), *(array.numpy() for array in made.multipliers if array is not None)]
    core, *others = found.values()
    assert not np.array_equal(core[0], d.numpy()) or name == "nothing"
    # A sweep moves a vertex by ω of what its constraints ask for, of y that are wrong by a few roundings of positions; λ is
    # that times the mass. The same kernels make the same bits.
    for expected, scattered, gathered_, paired in zip(core, *others, strict=True):
        assert np.array_equal(gathered_, paired)
        for each in (scattered, gathered_):
            assert np.abs(each - expected).max() <= steps * 8 * np.finfo(dtype).eps * max(np.abs(expected).max(), 0.1)


@pytest.mark.parametrize("copies", [1, 2])
def test_blocks_have_every_element_once(copies, device, monkeypatch):
    """In the block of its lowest vertex; runs have all vertices one higher from element to element; copies are alike."""
    monkeypatch.setattr(block_layout, "NUMBERS", 60)
    monkeypatch.setattr(block_layout, "RUN", 3)
    scene = declared([SPRINGS, wc.DihedralBending(stiffness=1e-3), wc.NeoHookeanMembrane(stiffness=100.0)])
    model = scene.build(device=device, copies=copies)
    vertices, terms, found, numbers = layout_of(model.terms, model.per_copy, copies)
    assert vertices[0] == 0 and vertices[-1] == model.count and (np.diff(vertices) > 0).all()
    assert np.isin(np.arange(copies) * N, vertices).all() and numbers <= 60
    runs = 0
    for before, after, arrays in zip(model.terms, terms, found, strict=True):
        stencil = after.stencil.numpy()
        assert sorted(map(tuple, stencil)) == sorted(map(tuple, before.stencil.numpy()))
        offsets, codes = arrays["offsets"].numpy(), arrays["codes"].numpy()
        firsts, counts = codes.reshape(-1, 2).T
        assert np.array_equal(firsts, np.cumsum(np.abs(counts)) - np.abs(counts))
        assert np.abs(counts).sum() == len(stencil)
        for block, (first, last) in enumerate(itertools.pairwise(vertices)):
            for first_element, count in codes.reshape(-1, 2)[offsets[block] : offsets[block + 1]]:
                piece = stencil[first_element : first_element + abs(count)]
                assert ((piece.min(axis=1) >= first) & (piece.min(axis=1) < last)).all()
                if count > 0:
                    runs += 1
                    assert count >= 3 and (np.diff(piece, axis=0) == 1).all()
    assert runs


def test_what_is_in_order_is_not_copied(device):
    """Elements are put in the order of a sweep once."""
    model = declared([SPRINGS, wc.DihedralBending(stiffness=1e-3)]).build(device=device)
    _vertices, ordered, _arrays, _numbers = layout_of(model.terms, model.per_copy, 1)
    _vertices, again, _arrays, _numbers = layout_of(ordered, model.per_copy, 1)
    for elements, same in zip(ordered, again, strict=True):
        assert same.stencil is elements.stencil


@pytest.mark.parametrize("spokes", [0, 10, 100])
def test_a_vertex_of_many_elements_does_not_blow_up_memory(spokes, device):
    """Rows of equal length have at most twice as many slots as there are incidences; else there are no slots to spare."""
    n = 200
    chain, star = np.arange(1, n), np.arange(2, spokes + 2)
    edges = np.vstack([np.stack([chain - 1, chain], axis=1), np.stack([0 * star, star], axis=1)])
    mesh = wc.Mesh(np.random.default_rng(0).normal(size=(n, 3)), edges=edges)
    model = wc.Scene(mesh, masses=np.ones(n), terms=[wc.Spring(stiffness=1.0)]).build(device=device)
    part, arrays = gathered(model, model.terms[0])
    assert part.pairs == (None if spokes else (1, 1)) and not part.padded
    assert len(arrays["codes"]) == (2 * len(edges) if spokes else 2 * n)


def test_the_residual_is_that_of_the_worst_step(device):
    """Of XPBD, which reads it once a frame; what is not finite stays so and is a divergence."""
    stepper = wc.XPBD(substeps=7, iterations=4).bind(declared([SPRINGS], fps=60.0).build(device=device))
    residuals = []
    for _ in range(14):
        stepper.step()
        residuals.append(stepper.residual[0])
    change = np.diff(residuals)
    assert (change >= 0.0).all() and (change == 0.0).any()
    place = stepper.state.x.numpy()
    stepper.state.x.assign(place * np.nan)
    stepper.step()
    stepper.state.x.assign(place)
    stepper.state.v.zero_()
    stepper.frame()
    assert np.isnan(stepper.residual[0]) and stepper.results == [Result.DIVERGED]


@pytest.mark.parametrize("backend", slow_but(["core", "blocks"], ["core", "blocks", "gather"]), indirect=True)
@pytest.mark.parametrize(("away", "substeps"), [(0.0, 64), (128.0, 64), (4096.0, 512)])
def test_motion_does_not_depend_on_where_the_origin_is(away, substeps, backend, device):
    """Far from it positions are kept to more digits than x has; frames are steps, and a run repeats itself, to the bit."""
    # Farther, steps of less than the unit of what is packed too.
    sheet = wc.Mesh.grid(17, 17)  # of positions that float32 has in both

    def stepper_of(away, dtype):
        mesh = wc.Mesh(sheet.points + away, sheet.triangles)
        terms = [wc.Spring(stiffness=100.0), wc.QuadraticBending(stiffness=1e-5)]
        scene = wc.Scene(mesh, density=0.1, terms=terms, pins=[0, 16], duration=1.0)
        return ExplicitStepper(wc.Explicit(substeps=substeps), scene.build(device=device, dtype=dtype), backend)

    exact, stepper, other = (stepper_of(*key) for key in ((0.0, "float64"), (away, "float32"), (away, "float32")))
    assert stepper.plan.record.compensated == ("position residual" in stepper.state.arrays) == (away > 0.0)
    for _ in range(20):
        exact.frame()
        stepper.frame()
        for _ in range(substeps):
            other.step()
    x = stepper.state.x.numpy().copy()
    # x is rounded by half of this; without the rest it is 50 times as far off.
    assert np.abs(x - away - exact.state.x.numpy()).max() < max(2.0 * np.spacing(np.float32(away)), 2e-5)
    assert np.array_equal(x, other.state.x.numpy())
    stepper.reset()
    assert np.array_equal(x, list(positions(stepper, 20))[-1])


@pytest.mark.parametrize(
    ("scene", "varied", "packed"),
    [
        ({"pins": [0]}, {}, True),
        ({"pins": [0], "duration": 1e4}, {}, True),  # held
        ({"duration": 1.0}, {}, True),
        ({"duration": 1e3}, {}, False),  # falls 5000 km
        ({"velocities": [1e5, 0.0, 0.0]}, {}, False),
        ({}, {"velocities": [0.0, 1e5, 0.0]}, False),
        ({}, {"gravity": [0.0, 0.0, 1e5]}, False),
        ({"pins": [0]}, {"positions": [4096.0, 0.0, 0.0]}, False),
        ({"pins": [0]}, {"velocities": [0.0, 1e5, 0.0]}, True),
        ({"pins": wc.Pins([0], [[[128.0] * 3], [[4096.0] * 3]])}, {}, False),
    ],
)
def test_the_residual_of_positions_is_packed_where_that_holds_it(scene, varied, packed, device):
    """Also at the ends that are known before a run: by units of less than positions may be rounded by there."""
    sheet = wc.Mesh.grid(17, 17)
    mesh = wc.Mesh(sheet.points + 128.0, sheet.triangles)
    if "velocities" in scene:
        scene = scene | {"velocities": np.zeros_like(mesh.points) + scene["velocities"]}
    scene = wc.Scene(mesh, density=0.1, terms=[wc.Spring(stiffness=100.0)], **scene)
    first = {"positions": mesh.points, "velocities": 0.0 * mesh.points, "gravity": np.array(scene.gravity)}
    vary = {name: np.stack([first[name], first[name] + more]) for name, more in varied.items()}
    model = scene.build(device=device, copies=2, vary=vary)
    found = ExplicitStepper(wc.Explicit(substeps=64), model, "gather").plan.record
    assert found.compensated and found.packed == packed
