"""Damping of every term: what it takes, what it leaves alone, in every solver that takes it."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

import warpcloth as wc
from support.energies import damping_forces
from support.nets import net
from support.rows import slow_but
from warpcloth.core.energy import Energy
from warpcloth.core.gradient import Gradient
from warpcloth.core.sums import Sums
from warpcloth.model.damping import damped_terms, dissipations
from warpcloth.solvers.explicit import step_limits
from warpcloth.terms.refresh import STEP, Moment

EPS = np.finfo(np.float64).eps
DAMPED = {
    "Spring": wc.Spring(pairs=("structural", "shear"), stiffness=30.0, damping=0.7),
    "CorotatedMembrane": wc.CorotatedMembrane(stiffness=30.0, damping=0.7),
    "StVKMembrane": wc.StVKMembrane(stiffness=30.0, poisson_ratio=0.3, damping=0.7),
    "NeoHookeanMembrane": wc.NeoHookeanMembrane(stiffness=30.0, poisson_ratio=0.3, damping=0.7),
    "OrthotropicMembrane": wc.OrthotropicMembrane(stiffness=30.0, weft_ratio=2.0, poisson_ratio=0.3, damping=0.7),
    "QuadraticBending": wc.QuadraticBending(stiffness=1e-2, damping=1e-3),
    "DihedralBending": wc.DihedralBending(stiffness=1e-2, damping=1e-3),
    "Attachment": wc.Attachment(vertices=[0, 5, 9], stiffness=30.0, damping=0.7),
}
INNER = [name for name in DAMPED if name != "Attachment"]  # which is anchored in the world
each_term = pytest.mark.parametrize("name", DAMPED)
each_inner = pytest.mark.parametrize("name", INNER)


def crumpled(name, n=5, seed=0, **scene):
    """A net of n² whose vertices are off their rest positions by a fifth of an edge, with one term."""
    mesh = wc.Mesh.grid(n, n, pattern="alternating")
    positions = mesh.points + 0.05 * np.random.default_rng(seed).normal(size=mesh.points.shape)
    return wc.Scene(mesh, density=1.0, positions=positions, terms=[DAMPED[name]], gravity=(0.0, 0.0, 0.0), **scene)


def rotation(axis, angle):
    K = np.cross(np.eye(3), np.asarray(axis) / np.linalg.norm(axis))
    return np.eye(3) - np.sin(angle) * K + (1.0 - np.cos(angle)) * K @ K


class Dissipation:
    """D and ∂D/∂x of a step of he from the positions of a scene, at any x; of another integrator by what it ``knows``."""

    def __init__(self, scene, he, device, move=None, **knows):
        self.model = scene.build(device=device, dtype="float64")
        terms = dissipations(self.model, he)
        move = None if move is None else self.model.array(move, self.model.vec3)
        self.model.refresh(STEP, Moment(self.model.positions, move=move, **knows), terms)
        self.energy_of = Energy(self.model, Sums(self.model), terms=terms)
        self.gradient_of = Gradient(self.model, terms=terms)

    def energy(self, x):
        out = wp.zeros(1, dtype=wp.float64, device=self.model.device)
        self.energy_of.add(self.model.array(x, self.model.vec3), out)
        return out.numpy()[0]

    def gradient(self, x):
        out = self.model.vectors()
        self.gradient_of.add(self.model.array(x, self.model.vec3), out)
        return out.numpy()


@each_inner
def test_a_rigid_step_is_free(name, device):
    """No force, to the rounding of s in forces of size A(β/h)|s|·|∂s|, though each vertex moves by its own length."""
    scene, h = crumpled(name), 0.01
    D = Dissipation(scene, h, device)
    x = scene.positions @ rotation((1.0, 2.0, 3.0), np.radians(30.0)).T + [0.3, -2.0, 0.7]
    assert np.abs(D.gradient(scene.positions * [1.1, 1.0, 0.9])).max() > 1e-3, "what is no rigid step is damped"
    sizes = {"QuadraticBending": 1e-3 * 100.0, "DihedralBending": 1e-3 * 100.0}  # β/m² · rounding of a sum of ten lengths
    assert np.abs(D.gradient(x)).max() < 1e3 * EPS / h * sizes.get(name, 0.7)
    assert D.energy(x) < (1e3 * EPS) ** 2 / h


@each_inner
def test_a_rigid_field_is_free_to_first_order(name, device):
    """x + h v with v = ω × x is no rigid step, but turned by hω it is longer by (hω)²/2 only: a force of order h."""
    scene = crumpled(name)
    velocities = np.cross([1.0, -2.0, 0.5], scene.positions)
    forces = []
    for h in (1e-3, 5e-4):
        model = replace(scene, velocities=velocities).build(device=device, dtype="float64")
        forces.append(np.abs(damping_forces(model, h, model.positions, model.velocities.numpy())).max())
    assert forces[0] > 1e4 * EPS
    assert np.log2(forces[0] / forces[1]) == pytest.approx(1.0, abs=0.05)


@each_term
def test_it_only_takes(name, device):
    """D ≥ 0; and the power of its force in the motion that it is taken of is −β‖ds/dt‖² + O(h)."""
    powers = []
    for seed in range(5):
        scene = crumpled(name, seed=seed)
        v = np.random.default_rng(100 + seed).normal(size=scene.positions.shape)
        for h in (1e-2, 1e-3):
            D = Dissipation(scene, h, device)
            assert D.energy(scene.positions + h * v) > 0.0
        D = Dissipation(scene, 1e-6, device)
        powers.append((-D.gradient(scene.positions + 1e-6 * v) * v).sum())
    assert max(powers) < 0.0


def viscous(name, x, v, device):
    """β ds/dt ∂s of a motion through x with v, by central differences."""
    scene, delta = replace(crumpled(name), positions=x), 1e-5
    D = Dissipation(scene, delta, device)
    return 0.5 * (D.gradient(x + delta * v) - D.gradient(x - delta * v))


@pytest.mark.parametrize(("integrator", "order"), [("euler", 1), ("midpoint", 2), ("bdf2", 2)])
@each_term
def test_the_rate_has_the_order_of_the_integrator(name, integrator, order, device):
    """∂D/∂x at the end of a step along x + vt + at²/2, at its middle for midpoint, less β ds/dt ∂s there."""
    scene, errors = crumpled(name), []
    v, a = np.random.default_rng(7).normal(size=(2, *scene.positions.shape))

    def at(t):
        return scene.positions + t * v + 0.5 * t * t * a

    for h in (2e-3, 1e-3):
        if integrator == "euler":
            x, rate, D = at(h), v + h * a, Dissipation(scene, h, device)
        elif integrator == "bdf2":
            x, rate, D = at(h), v + h * a, Dissipation(scene, 2.0 * h / 3.0, device, at(0.0) - at(-h), parts=3)
        else:
            x, rate = 0.5 * (at(0.0) + at(h)), v + 0.5 * h * a
            D = Dissipation(scene, 0.5 * h, device, v, scale=0.5 * h, parts=2, both=True)
        exact = viscous(name, x, rate, device)
        errors.append(np.linalg.norm(D.gradient(x) - exact) / np.linalg.norm(exact))
    if name == "Attachment" and errors[-1] < 1e-9:  # s is linear, and so exact: BDF2 of this motion and midpoint
        assert integrator != "euler"
        return
    assert np.log2(errors[-2] / errors[-1]) == pytest.approx(order, abs=0.15)


@pytest.mark.parametrize("name", INNER)
def test_midpoint_brakes_a_turning_body_by_the_cube_of_the_step(name, device):
    """(s(xₘ) − s̃)/hₑ of chords of a turning body, half as long as its step; s of the mean state less sₙ would leave O(h)."""
    scene, forces = crumpled(name), []
    for angle in (0.1, 0.05):
        h, turn = angle, [rotation((1.0, 2.0, 3.0), part * angle) for part in (0.0, 1.0)]
        x0, x1 = (scene.positions @ R.T for R in turn)
        v = np.cross(np.array([1.0, 2.0, 3.0]) / np.sqrt(14.0), x0)
        D = Dissipation(scene, 0.5 * h, device, v, scale=0.5 * h, parts=2, both=True)
        forces.append(np.abs(D.gradient(0.5 * (x0 + x1))).max())
    assert forces[0] > 1e6 * EPS
    assert np.log2(forces[0] / forces[1]) == pytest.approx(3.0, abs=0.2)


@each_term
def test_gradient_is_that_of_the_dissipation(name, device):
    """Central differences about a state other than the one it is taken from; their error is δ²/6 of the third derivative."""
    scene, delta = crumpled(name), 1e-6
    D = Dissipation(scene, 0.01, device)
    rng = np.random.default_rng(3)
    x, direction = scene.positions + 0.02 * rng.normal(size=scene.positions.shape), rng.normal(size=scene.positions.shape)
    slope = (D.energy(x + delta * direction) - D.energy(x - delta * direction)) / (2.0 * delta)
    exact = (D.gradient(x) * direction).sum()
    assert abs(exact) > 1e-6
    assert slope == pytest.approx(exact, rel=1e-6)


@pytest.mark.parametrize("name", [name for name in DAMPED if "Membrane" not in name])
def test_merged_is_the_sum(name, device):
    """Stiffness and damping of one element have, up to a constant, the energy of U + D, and so their force."""
    he = 0.004
    model = crumpled(name).build(device=device, dtype="float64")
    merged, apart = damped_terms(model, he), [*model.terms, *dissipations(model, he)]
    assert len(merged) == 1
    x = model.array(model.positions.numpy() + 0.02 * np.random.default_rng(5).normal(size=(model.count, 3)), model.vec3)
    move = model.array(0.01 * np.random.default_rng(6).normal(size=(model.count, 3)), model.vec3)
    for before in (None, move):
        found = []
        for terms in (merged, apart):
            model.refresh(STEP, Moment(model.positions, move=before), terms)
            found.append(model.vectors())
            Gradient(model, terms=terms).add(x, found[-1])
        merged_force, force = (array.numpy() for array in found)
        assert np.abs(merged_force - force).max() < 1e3 * EPS * np.abs(force).max()


def test_merging_is_element_by_element(device):
    """Also where the first and the last element agree, and one has neither stiffness nor damping."""
    he, stiffness, damping = 0.5, np.full(72, 30.0), np.full(72, 0.7)
    stiffness[7], damping[7:9] = 0.0, (0.0, 2.0)
    scene = replace(crumpled("Spring"), terms=[replace(DAMPED["Spring"], stiffness=stiffness, damping=damping)])
    (merged,) = damped_terms(scene.build(device=device, dtype="float64"), he)
    both = stiffness + damping / he
    assert np.array_equal(merged.stiffness.numpy(), both)
    assert np.abs(merged.refresh.arrays[1].numpy() - damping / he / np.where(both > 0.0, both, 1.0)).max() < 4 * EPS


def test_lengths_to_come_are_none_below_nought(device):
    """A spring that shrank to less than a quarter in the last step of BDF2 has s̃ = (4s₀ − s₋₁)/3 < 0, which no length is."""
    scene, rests = crumpled("Spring"), []
    for scale in (-1.0, -4.0):  # x₀ − x₋₁ = scale·x₀: from 2 and from 5 times the size
        D = Dissipation(scene, 0.1, device, scale * scene.positions, parts=3)
        (elements,) = dissipations(D.model, 0.1)
        move = D.model.array(scale * scene.positions, D.model.vec3)
        D.model.refresh(STEP, Moment(D.model.positions, move=move, parts=3), [elements])
        rests.append(elements.rest.numpy()[:, 0])
    y = np.diff(scene.positions[scene.terms[0].stencil(scene.mesh)], axis=1)[:, 0]
    assert np.abs(rests[0] - (4.0 - 2.0) / 3.0 * np.linalg.norm(y, axis=1)).max() < 100 * EPS
    assert (rests[1] == 0.0).all()


@pytest.mark.parametrize("integrator", ["euler", "midpoint", "bdf2"])
def test_a_hinge_is_damped_through_folded_flat(integrator, device):
    """θ jumps there by 2π and its rate does not: D of a step through it is that of the same turn an angle of 1 before."""
    mesh = wc.Mesh(np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.5, 1.0, 0.0], [0.5, -1.0, 0.0]]), [[0, 1, 2], [1, 0, 3]])
    turn, he, beta, found = 0.03, 0.1, 0.4, []

    def at(angle):
        x = mesh.points.copy()
        x[2] = [0.5, np.cos(angle), np.sin(angle)]
        return x

    for sign in (1.0, -1.0):
        for first in (np.pi - 1.0, np.pi - 1.3 * turn, np.pi - 0.2 * turn, np.pi + 0.5 * turn):
            before, now, after = (at(sign * (first + part * turn)) for part in (-1.0, 0.0, 1.0))
            terms = [wc.DihedralBending(stiffness=0.0, damping=beta)]
            scene = wc.Scene(mesh, masses=np.ones(4), positions=now, terms=terms, gravity=(0.0, 0.0, 0.0))
            knows = {"euler": {}, "midpoint": {"parts": 2, "both": True}, "bdf2": {"parts": 3}}[integrator]
            D = Dissipation(scene, he, device, now - before if knows else None, **knows)
            found.append(D.energy(after))
    assert found == pytest.approx([found[0]] * len(found), rel=1e-9)
    # The measure of this hinge is 1, and the changes of s less s̃ are those of a steady turn.
    expected = {"euler": 1.0, "midpoint": 1.0, "bdf2": 2.0 / 3.0}[integrator] * turn
    assert found[0] == pytest.approx(0.5 * beta / he * expected**2, rel=2.0 * turn)


def oscillator(damping, omega=2.0, h=0.1):
    """A unit mass on a damped spring of rest length 1 from a pin, stretched by 0.25: u″ = −ω²u − βu′."""
    mesh = wc.Mesh(np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]), edges=[[0, 1]])
    given = {"masses": [1.0, 1.0], "positions": [[0.0, 0.0, 0.0], [1.25, 0.0, 0.0]]}
    given |= {"velocities": [[0.0, 0.0, 0.0], [0.5, 0.0, 0.0]], "terms": [wc.Spring(stiffness=omega**2, damping=damping)]}
    given |= {"pins": [0], "gravity": (0.0, 0.0, 0.0), "fps": 1.0 / h, "duration": h}
    return wc.Scene(mesh, **given)


def implicit(integrator):
    return {
        "newton": wc.Newton(substeps=1, tolerance=1e-11, integrator=integrator),
        "projective dynamics": wc.ProjectiveDynamics(substeps=1, tolerance=1e-11, iterations=200, integrator=integrator),
        "admm": wc.ADMM(substeps=1, tolerance=1e-11, iterations=2000, integrator=integrator),
        "xpbd": wc.XPBD(substeps=1, iterations=60, integrator=integrator),
        "xpbd scalar": wc.XPBD(substeps=1, iterations=60, integrator=integrator, form="scalar"),
    }


SOLVERS = {f"{name} {way}": solver for way in ("euler", "midpoint", "bdf2") for name, solver in implicit(way).items()}
SOLVERS["explicit"] = wc.Explicit(substeps=1)
SOLVERS["pbd"] = wc.PBD(substeps=1, iterations=1)
SOLVERS["pbd per step"] = wc.PBD(substeps=1, iterations=7, correction="per-step")


@pytest.mark.host
@pytest.mark.parametrize("name", slow_but(("newton bdf2", "xpbd midpoint", "explicit", "pbd per step"), SOLVERS))
def test_a_damped_oscillator(name, device):
    """u = e^{−βt/2}(u₀ cos + (v₀ + βu₀/2)/ω' sin), approached with the order of the method. BDF2 needs two states for ds/dt."""
    beta, omega, end, errors = 1.5, 2.0, 1.0, []
    slow = np.sqrt(omega**2 - beta**2 / 4.0)
    u = np.exp(-0.5 * beta * end) * (0.25 * np.cos(slow * end) + (0.5 + 0.125 * beta) / slow * np.sin(slow * end))
    for steps in (40, 80):
        stepper = SOLVERS[name].bind(oscillator(beta, omega, end / steps).build(device=device, dtype="float64"))
        for _ in range(steps):
            stepper.step()
        errors.append(abs(stepper.state.x.numpy()[1, 0] - 1.0 - u))
    order = 2 if "midpoint" in name or "bdf2" in name else 1
    assert np.log2(errors[-2] / errors[-1]) == pytest.approx(order, abs=0.15)
    assert errors[-1] < 0.05 * 0.25


@pytest.mark.parametrize("beta", [0.0, 1.0, 10.0])
def test_limit_of_the_explicit_step_falls(beta, device):
    """z² − z(2 − h²ω² − hβ) + 1 − hβ = 0 leaves the unit circle at z = −1, where h²ω² + 2hβ = 4."""
    omega = 2.0
    scene = oscillator(beta, omega)
    limit = step_limits(scene.build(device=device, dtype="float64"))[0]
    assert limit == pytest.approx(4.0 / (beta + np.sqrt(beta**2 + 4.0 * omega**2)), rel=1e-9)
    ends = []
    for part in (0.99, 1.01):
        scene = replace(oscillator(beta, omega, part * limit), velocities=[[0, 0, 0], [1e-6, 0, 0]], positions=None)
        stepper = wc.Explicit(substeps=1, above_limit="allow").bind(scene.build(device=device, dtype="float64"))
        for _ in range(1000):
            stepper.step()
        ends.append(abs(stepper.state.v.numpy()[1, 0]))
    assert ends[0] < 2e-6 / (0.02 if beta == 0.0 else 1.0)
    assert ends[1] > 1e-3


def test_limit_of_a_damped_net(device):
    """With damping in proportion to stiffness the stiffest mode is also the most damped."""
    scene, ratio = net("shear", n=12), 0.3
    k = 4.0 / step_limits(scene.build(device=device, dtype="float64"))[0] ** 2
    damped = replace(scene, terms=[replace(scene.terms[0], damping=ratio)])
    c = ratio * k
    limit = step_limits(damped.build(device=device, dtype="float64"))[0]
    assert limit == pytest.approx(4.0 / (c + np.sqrt(c * c + 4.0 * k)), rel=1e-3)


def test_limit_where_one_part_is_stiff_and_another_damped(device):
    """That of the worse part, though no part has both the largest stiffness and the largest damping."""
    mesh = wc.Mesh(np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0]]), edges=[[0, 1], [2, 3]])
    for k, beta in (((9.0, 1.0), (0.0, 2.0)), ((4.0, 1.0), (0.5, 3.0)), ((10.0, 0.0), (0.0, 10.0 / 3.0))):
        spring = wc.Spring(stiffness=k, damping=beta)
        scene = wc.Scene(mesh, masses=np.ones(4), terms=[spring], pins=[0, 2], gravity=(0.0, 0.0, 0.0))
        rest, motion = step_limits(scene.build(device=device, dtype="float64"))
        k, beta = np.array(k), np.array(beta)
        assert rest == pytest.approx((4.0 / (beta + np.sqrt(beta**2 + 4.0 * k))).min(), rel=1e-6)
        k, beta = 2.0 * k, 2.0 * beta  # of Gershgorin, with the block of the pin
        assert motion == pytest.approx((4.0 / (beta + np.sqrt(beta**2 + 4.0 * k))).min(), rel=1e-9)


EXPLICIT, MIDPOINT = wc.Explicit(substeps=1), wc.Newton(substeps=1, tolerance=1e-12, integrator="midpoint")


@pytest.mark.parametrize(
    ("name", "solver"),
    slow_but(
        [(name, EXPLICIT) for name in ("Spring", "StVKMembrane", "QuadraticBending")],
        [  # the damping of all membranes is one energy, and explicit steps are compiled for each
            *((name, EXPLICIT) for name in ("Spring", "StVKMembrane", "QuadraticBending", "DihedralBending")),
            *((name, MIDPOINT) for name in INNER),
        ],
    ),
)
def test_momentum_is_kept(name, solver, device):
    """Damping forces are inner ones along ∂s: linear and angular momentum stay, as they do without."""
    scene = crumpled(name, fps=2000.0, velocities=np.random.default_rng(1).normal(size=(25, 3)))
    stepper = solver.bind(scene.build(device=device, dtype="float64"))
    mass = scene.vertex_masses[:, None]

    def momenta():
        x, v = stepper.state.x.numpy(), stepper.state.v.numpy()
        return np.concatenate([(mass * v).sum(axis=0), np.cross(x, mass * v).sum(axis=0)])

    before, scale = momenta(), (mass * np.abs(scene.velocities)).sum()
    for _ in range(20):
        stepper.step()
    change = np.abs(momenta() - before)
    assert change[:3].max() < 1e-9 * scale
    # The explicit force is taken at x + h v, of which the moment about x is of order h, for 20 steps of h.
    assert change[3:].max() < (8e-4 if isinstance(solver, wc.Explicit) else 1e-9) * scale


@pytest.mark.parametrize("solver", [wc.Explicit(substeps=1), wc.Newton(substeps=1, tolerance=1e-12, integrator="midpoint")])
def test_a_spinning_body_goes_on(solver, device):
    """Two masses that turn, held in balance by a spring: angular momentum as without damping, up to h² over the time."""
    # The rate of a length that stays is of order h, and so is the moment of its force, taken at x + h v; midpoint keeps all.
    changes = []
    for h in (4e-3, 2e-3):
        length, omega, k = 1.0, 2.0, 100.0
        rest = length * (1.0 - omega**2 / (2.0 * k))  # k(l − L) = ω²l/2 of unit masses
        mesh = wc.Mesh(np.array([[-0.5 * rest, 0.0, 0.0], [0.5 * rest, 0.0, 0.0]]), edges=[[0, 1]])
        x = np.array([[-0.5 * length, 0.0, 0.0], [0.5 * length, 0.0, 0.0]])
        spring = wc.Spring(stiffness=k, damping=1.0)
        v = np.cross([0.0, 0.0, omega], x)
        scene = wc.Scene(mesh, masses=[1.0, 1.0], positions=x, velocities=v, terms=[spring], fps=1.0 / h, gravity=(0, 0, 0))
        stepper = solver.bind(scene.build(device=device, dtype="float64"))
        for _ in range(round(1.0 / h)):
            stepper.step()
        changes.append(abs(np.cross(*(array.numpy() for array in stepper.state)).sum(axis=0)[2] - 0.5 * omega * length**2))
    if isinstance(solver, wc.Newton):
        assert max(changes) < 1e-9
    else:
        assert changes[0] < 0.1 * 4e-3 and np.log2(changes[0] / changes[1]) == pytest.approx(2.0, abs=0.2)


def test_a_rest_shape_knows_no_damping(device):
    """Where nothing moves there is no rate: :func:`warpcloth.equilibrium` ends in the same bits."""
    chain = wc.Mesh(np.array([[0.1 * i, 0.0, 0.0] for i in range(6)]), edges=[[i, i + 1] for i in range(5)])
    scenes = [
        wc.Scene(chain, masses=np.ones(6), terms=[wc.Spring(stiffness=1e3, damping=damping)], pins=[0, 5])
        for damping in (None, 3.0)
    ]
    undamped, damped = (wc.equilibrium(scene, device=device).points for scene in scenes)
    assert np.array_equal(damped, undamped) and undamped[2, 1] < -0.01


@pytest.mark.parametrize(
    "solver",
    slow_but(
        [wc.Newton, wc.PBD, wc.XPBD, wc.ADMM],
        [wc.Newton, wc.PBD, wc.HierarchicalPBD, wc.XPBD, wc.ProjectiveDynamics, wc.ADMM, wc.ConstrainedDynamics, wc.Explicit],
    ),
)
def test_it_calms_a_cloth(solver, device):
    """Damping lowers the rates of length of springs by far, and does not move the centre."""
    ends = []
    for damping in (None, 0.5):
        mesh = wc.Mesh.grid(6, 6)
        spring = wc.Spring(pairs=("structural", "shear"), stiffness=50.0, damping=damping)
        velocities = np.random.default_rng(2).normal(size=(36, 3))
        velocities -= velocities.mean(axis=0)
        scene = wc.Scene(mesh, masses=np.full(36, 1 / 360), terms=[spring], velocities=velocities, fps=240.0, gravity=(0, 0, 0))
        stepper = solver(substeps=4).bind(scene.build(device=device, dtype="float64"))
        for _ in range(20):
            stepper.step()
        x, v = stepper.state.x.numpy(), stepper.state.v.numpy()
        y, change = (np.diff(values[spring.stencil(mesh)], axis=1)[:, 0] for values in (x, v))
        ends.append((((y * change).sum(axis=1) / np.linalg.norm(y, axis=1)) ** 2).mean())
        assert np.abs(v.mean(axis=0)).max() < 1e-3  # Newton stops at 1e-3 of the first unbalanced acceleration
    assert ends[1] < 0.5 * ends[0]


@pytest.mark.parametrize("integrator", slow_but(["midpoint"], ["euler", "midpoint", "bdf2"]))
def test_damped_steps_meet_at_one_minimiser(integrator, device):
    """Newton, projective dynamics, ADMM and XPBD on springs, quadratic bending and attachments, all damped: 1e-8 m."""
    # ADMM without bending: ½(‖y‖ − s̄)² of a y near 0 is concave around it, and there it need not converge.
    mesh = wc.Mesh.grid(5, 5, pattern="alternating")
    given = {"density": 1.0, "positions": 1.02 * mesh.points, "velocities": 0.3 * np.random.default_rng(0).normal(size=(25, 3))}
    given |= {"terms": [DAMPED["Spring"], DAMPED["Attachment"], DAMPED["QuadraticBending"]], "pins": "corners", "fps": 120.0}
    scene = wc.Scene(mesh, **given)

    def end(solver, count):
        changes = {"iterations": 5000, **({} if isinstance(solver, wc.XPBD) else {"tolerance": 1e-11})}
        model = replace(scene, terms=scene.terms[:count]).build(device=device, dtype="float64")
        stepper = replace(solver, **changes).bind(model)
        for _ in range(3):
            stepper.step()
        return stepper.state.x.numpy()

    solvers = implicit(integrator)
    for name in ("projective dynamics", "xpbd", "admm"):
        count = 2 if name == "admm" else 3
        assert np.abs(end(solvers[name], count) - end(solvers["newton"], count)).max() < 1e-8, name


@pytest.mark.parametrize("name", [name for name in DAMPED if "Membrane" in name])
@pytest.mark.parametrize("solver", [wc.PBD, wc.HierarchicalPBD, wc.XPBD, wc.ConstrainedDynamics])
def test_what_does_not_merge_is_refused(name, solver, device):
    with pytest.raises(ValueError, match=f"cannot take (the damping of )?{name}, .*; Explicit, Newton, Proj.* or ADMM can"):
        solver(substeps=1).bind(crumpled(name).build(device=device))


def test_copies_are_damped_by_themselves(device):
    """vary={"Spring.damping": …} is as if each were alone, and 0 is no damping."""
    base = crumpled("Spring", fps=240.0, pins="corners")
    values = [0.0, 0.2, 2.0]
    solver = wc.XPBD(substeps=1)
    model = {"copies": 3, "vary": {"Spring.damping": values}, "device": device, "dtype": "float64", "frames": 10}
    batch = wc.simulate(base, solver, **model).points
    for copy, damping in enumerate(values):
        alone = replace(base, terms=[replace(base.terms[0], damping=damping)])
        assert np.array_equal(batch[:, copy], wc.simulate(alone, solver, device=device, dtype="float64", frames=10).points)


def test_infinite_stiffness_has_no_rate(device):
    """A hard spring does not change its length, so there is nothing to damp."""
    scene = crumpled("Spring", fps=240.0, pins="corners")
    ends = []
    for damping in (None, 1.0):
        term = replace(scene.terms[0], stiffness=np.inf, damping=damping)
        ends.append(wc.simulate(replace(scene, terms=[term]), wc.PBD(substeps=1), device=device, frames=5).points)
    assert np.array_equal(*ends)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: wc.Spring(stiffness=1.0, damping=-1.0), "Spring.damping is -1.0; it must be finite, 0 or more"),
        (lambda: wc.Spring(stiffness=1.0, damping=np.inf), "Spring.damping is inf"),
        (lambda: wc.Spring(stiffness=1.0, damping=[1.0, np.nan]), r"Spring.damping\[1\] is nan"),
        (lambda: wc.DihedralBending(stiffness=1.0, damping="much"), "DihedralBending.damping is 'much'"),
        (lambda: crumpled("Spring").build(vary={"Spring.damping": [-1.0]}), "Spring.damping is -1.0 in copy 0"),
        (
            lambda: limited().build(vary={"SpringLimit.damping": [1.0]}),
            "'SpringLimit.damping'] names nothing in this scene; allowed are ",
        ),
        (lambda: replace(crumpled("Spring"), terms=[wc.Spring(stiffness=1.0, damping=[1.0, 2.0])]).build(), "has shape"),
    ],
)
def test_bad_damping_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def limited():
    return replace(crumpled("Spring"), terms=[wc.SpringLimit(most=1.1)])


def test_undamped_is_as_before(device):
    """Neither arrays nor kernels of damping where none is declared, or where it is 0 everywhere."""
    for damping in (None, 0.0, np.zeros(72)):
        scene = crumpled("Spring", fps=240.0)
        scene = replace(scene, terms=[replace(scene.terms[0], damping=damping)])
        model = scene.build(device=device)
        stepper = wc.Newton(substeps=1).bind(model)
        assert model.terms[0].damping is None and stepper.model.terms == model.terms
        assert not any("damp" in kernel for kernel in model.kernels)
