"""The contract of a term, over the whole catalogue: every test here runs for every energy that there is.

Elements are tested by themselves, as stencils that share no vertex, through the kernels that the solvers use.
"""

from functools import cache, partial
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest
import warp as wp

import warpcloth as wc
from support.energies import (
    CELL,
    DENSITIES,
    EQUILATERAL,
    FEW,
    HALF,
    MATERIALS,
    bending_density,
    energy_and_gradient,
    eps,
    every_dtype,
    material_of,
    model_of,
    random_rotation,
)
from support.meshes import rolled
from support.outside import Plane
from support.rows import slow_but
from warpcloth.core.gradient import Gradient
from warpcloth.core.hessian import Hessian
from warpcloth.core.hessian import norms as block_norms
from warpcloth.fast import quadratic_pairs as quadratic
from warpcloth.fast.gather_layout import gathered
from warpcloth.fast.structs import chained
from warpcloth.kernels import admm, assemble
from warpcloth.kernels import constraint_jacobian as jacobian
from warpcloth.kernels import constraint_rows as constrain
from warpcloth.kernels.fast import gather_forces as gather
from warpcloth.kernels.fast import scatter_corrections
from warpcloth.kernels.fast.term_facts import chain_of
from warpcloth.kernels.term import HessianPolicy, Term
from warpcloth.kernels.vectors import types
from warpcloth.model.precision import DTYPES
from warpcloth.terms import TERMS, needs

RAW, CLAMP, ABSOLUTE = HessianPolicy


def _has_another(term):
    """Whether its damping is another energy."""
    return term.dissipation is not None and term.dissipation.term is not None


# Elements by themselves; cells are in test_clusters.py.
DECLARABLE = tuple(energy.term for energy in (*TERMS.values(), Plane) if not energy.term.cells)
# And what damping makes of those whose sum with it is another energy, or that it stands beside.
CATALOGUE = (*DECLARABLE, *dict.fromkeys(term.dissipation.term for term in DECLARABLE if _has_another(term)))
SCALES = (1.0, 0.1, 0.01, 0.001)


def named(terms):
    return {"argvalues": terms, "ids": [term.name for term in terms]}


# One of each number of vertices, whose kernels compile in a second or so.
QUICK = ("Spring", "Attachment", "StVKMembrane", "QuadraticBending")


def quick(terms):
    """All, of which some run always."""
    kept = [term for term in terms if term.name in QUICK]
    return named(terms) | {"argvalues": slow_but(kept, terms)}


every_term = pytest.mark.parametrize("term", **named(CATALOGUE))
MEMBRANES = tuple(term.name for term in DECLARABLE if term.vertices == 3)
LIMITS = tuple(term.name for term in DECLARABLE if term.dead_zone)


term_of = {term.name: term for term in CATALOGUE}.get


def rest_state(term, points, indices):
    """Rest state of a term of the tests' material, (E, P)."""
    return term.rest_state(points, indices, **MATERIALS.get(term.name, {}))


projecting = pytest.mark.parametrize("term", **named([term for term in CATALOGUE if term.project]))
constraining = pytest.mark.parametrize("term", **named([term for term in CATALOGUE if term.constraint]))
world_bound = pytest.mark.xfail(raises=AssertionError, reason="is tied to the world, so moving all vertices costs energy")
invariant = pytest.mark.parametrize(
    "term",
    [pytest.param(term, marks=world_bound if term.vertices == 1 else (), id=term.name) for term in CATALOGUE],
)


# --- elements by themselves


class Stencils(NamedTuple):
    """E elements of one term that share no vertex, in one precision, on one device."""

    term: Term
    x: np.ndarray  # (E, K, 3) [m]
    rest: np.ndarray  # (E, P)
    stiffness: np.ndarray  # (E,)
    dtype: str = "float64"
    device: str = "cpu"

    def at(self, x):
        return self._replace(x=np.asarray(x, dtype=self.dtype))

    def array(self, values, dtype):
        return wp.array(np.ascontiguousarray(values, dtype=self.dtype), dtype=dtype, device=self.device)

    @property
    def scalar(self):
        return DTYPES[self.dtype][0]

    @property
    def stencil(self):
        E, K = self.x.shape[:2]
        return wp.array(np.arange(E * K, dtype=np.int32).reshape(E, K), dtype=wp.int32, device=self.device)

    @property
    def elements(self):
        rest = self.array(self.rest, wp.types.vector(self.term.parameters, self.scalar))
        return [self.stencil, self.array(self.stiffness, self.scalar), rest]

    def places(self, x=None):
        return self.array((self.x if x is None else x).reshape(-1, 3), types(self.scalar)[0])

    def launch(self, kernel, *arguments):
        wp.launch(kernel, dim=len(self.x), inputs=list(arguments), device=self.device)

    def state(self, factory, correction):
        """The kernel of a factory, its elements, and the places, with a correction d (E, K, 3) or without."""
        corrected = () if correction is None else (True,)
        d = None if correction is None else self.places(correction)
        return factory(self.term, self.scalar, *corrected), *self.elements, self.places(), d

    def energy(self, correction=None):
        """(E,) [J]."""
        out = self.zeros(len(self.x), dtype=wp.float64)
        self.launch(*self.state(assemble.energy, correction), None, out)
        return out.numpy()

    def gradient(self, correction=None):
        """(E, K, 3) [N]."""
        out = self.places(np.zeros_like(self.x))
        kernel, stencil, stiffness, rest, x, d = self.state(assemble.scatter_gradient, correction)
        self.launch(kernel, stencil, rest, elastic(self.term, self.scalar, stencil, stiffness, x, d), out)
        return out.numpy().reshape(self.x.shape)

    def hessian(self, policy=RAW, correction=None):
        """(E, 3K, 3K) [N/m]."""
        E, K = self.x.shape[:2]
        out = self.zeros(E, K * K, dtype=types(self.scalar)[1])
        policies = wp.array([float(policy)], dtype=wp.float64, device=self.device)
        self.launch(*self.state(assemble.hessian_blocks, correction), E, policies, out)
        return out.numpy().reshape(E, K, K, 3, 3).transpose(0, 1, 3, 2, 4).reshape(E, 3 * K, 3 * K)

    def correction(self, inverse_mass, h):
        """Δx (E, K, 3) [m] of one projection, for a step of h [s]."""
        out = self.places(np.zeros_like(self.x))
        masses, zero = self.array(inverse_mass.ravel(), self.scalar), self.places(np.zeros_like(self.x))
        factor = self.array(np.ones(len(self.x)), self.scalar)
        kernel = scatter_corrections.scatter_correction(self.term, self.scalar, self.term.project is None)
        self.launch(kernel, *self.elements, masses, factor, None, self.places(), zero, h, 1, None, out)
        return out.numpy().reshape(self.x.shape)

    def zeros(self, *shape, dtype):
        return wp.zeros(shape, dtype=dtype, device=self.device)

    def weights(self):
        """Weights of every vertex (E, K, M), measures (E,)."""
        E, K, M = len(self.x), self.term.vertices, self.term.rows
        weights, measures = self.zeros(E, K, dtype=wp.types.vector(M, self.scalar)), self.zeros(E, dtype=self.scalar)
        self.launch(weights_of(self.term, self.scalar), self.elements[2], weights, measures)
        return weights.numpy().reshape(E, K, M), measures.numpy()

    def hard(self):
        return self._replace(stiffness=np.full(len(self.x), np.inf))

    def y(self):
        """Local coordinates (E, M, 3) [m], summed in double precision."""
        return np.einsum("ekm,ekc->emc", self.weights()[0], self.x, dtype=np.float64)

    def projection(self, y):
        """p(y) (E, M, 3)."""
        y_type, _, _ = types_of(self.term, self.scalar)
        out = self.zeros(len(y), dtype=y_type)
        self.launch(projection_of(self.term, self.scalar), self.array(y, y_type), self.elements[2], out)
        return out.numpy().reshape(y.shape)

    def second_derivative(self, y, policy):
        """∂²u/∂y² (E, 3M, 3M)."""
        y_type, _, square = types_of(self.term, self.scalar)
        out, kernel = self.zeros(len(y), dtype=square), second_derivative_of(self.term, self.scalar)
        self.launch(kernel, self.array(y, y_type), self.elements[2], self.scalar(policy), out)
        return out.numpy()

    def constraint(self, y):
        """C (E,), ∂C/∂y (E, 3M), ∂²C/∂y² (E, 3M, 3M)."""
        y_type, _, square = types_of(self.term, self.scalar)
        out = [self.zeros(len(y), dtype=kind) for kind in (self.scalar, y_type, square)]
        self.launch(constraint_of(self.term, self.scalar), self.array(y, y_type), self.elements[2], *out)
        return out[0].numpy(), out[1].numpy().reshape(len(y), -1), out[2].numpy()


def types_of(term, dtype):
    """Of y, of the rest state and of second derivatives."""
    M = term.rows
    matrices = (wp.types.matrix(shape, dtype) for shape in ((M, 3), (3 * M, 3 * M)))
    y_type, square = matrices
    return y_type, wp.types.vector(term.parameters, dtype), square


@cache
def weights_of(term, dtype):
    rest_type, weight_type = wp.types.vector(term.parameters, dtype), wp.types.vector(term.rows, dtype)
    K, weight, measure = wp.constant(term.vertices), term.weight, term.measure

    @wp.kernel(module="unique", enable_backward=False)
    def evaluate(rest: wp.array(dtype=rest_type), weights: wp.array2d(dtype=weight_type), measures: wp.array(dtype=dtype)):
        e = wp.tid()
        for i in range(K):
            weights[e, i] = weight(rest[e], i)
        measures[e] = measure(rest[e])

    return evaluate


@cache
def projection_of(term, dtype):
    (y_type, rest_type, _), nearest = types_of(term, dtype), term.project

    @wp.kernel(module="unique", enable_backward=False)
    def evaluate(y: wp.array(dtype=y_type), rest: wp.array(dtype=rest_type), out: wp.array(dtype=y_type)):
        e = wp.tid()
        out[e] = nearest(y[e], rest[e])

    return evaluate


@cache
def second_derivative_of(term, dtype):
    (y_type, rest_type, square), second = types_of(term, dtype), term.hessian

    @wp.kernel(module="unique", enable_backward=False)
    def evaluate(y: wp.array(dtype=y_type), rest: wp.array(dtype=rest_type), policy: dtype, out: wp.array(dtype=square)):
        e = wp.tid()
        out[e] = second(y[e], rest[e], policy)

    return evaluate


@cache
def constraint_of(term, dtype):
    y_type, rest_type, square = types_of(term, dtype)
    constraint, first, second = term.constraint, term.constraint_gradient, term.constraint_hessian

    @wp.kernel(module="unique", enable_backward=False)
    def evaluate(
        y: wp.array(dtype=y_type),
        rest: wp.array(dtype=rest_type),
        c: wp.array(dtype=dtype),
        dc: wp.array(dtype=y_type),
        ddc: wp.array(dtype=square),
    ):
        e = wp.tid()
        c[e] = constraint(y[e], rest[e])
        dc[e] = first(y[e], rest[e])
        ddc[e] = second(y[e], rest[e])

    return evaluate


@cache
def gradient_by_lanes(part, dtype, lanes):
    """:func:`gather.gather_forces` with one thread in place of the lanes of a vertex, which only CUDA can add up."""
    vec3, total_of = wp.types.vector(3, dtype), gather.gather_terms((part,), dtype, lanes=lanes)

    @wp.kernel(module="unique", enable_backward=False)
    def evaluate(chain: chain_of((part,), dtype), x: wp.array(dtype=vec3), d: wp.array(dtype=vec3), out: wp.array(dtype=vec3)):
        i = wp.tid()
        total = vec3()
        for lane in range(lanes):
            total += total_of(chain, i, lane, x.shape[0], x, d, dtype(1.0))
        out[i] = out[i] + total

    return evaluate


# --- states


def rest_mesh(seed=0):
    """An irregular sheet with a wave in it, about 1 m."""
    random, grid = np.random.default_rng(seed), wc.Mesh.grid(6, 5, pattern="alternating")
    points = grid.points + random.normal(scale=0.02, size=grid.points.shape)
    points[:, 1] += 0.05 * np.sin(5.0 * points[:, 0])
    return wc.Mesh(points, grid.triangles)


def folded(points):
    """Folded over at a column of vertices, the halves 0.03 m apart at the far ends."""
    flap = np.maximum(points[:, 0] - 0.6, 0.0)
    return points + flap[:, None] * np.array([-1.97, 0.1, 0.0])


STATES = {
    "random": lambda points: 1.1 * points,
    "compressed": lambda points: 0.6 * points,
    "stretched": lambda points: points * np.array([1.7, 1.3, 1.5]),
    "folded": folded,
}

# The stencils on a mesh, by what a term's stencil is: one vertex, a pair, a triangle, a hinge.
ON_MESH = {
    1: lambda mesh: np.arange(len(mesh.points))[:, None],
    2: lambda mesh: mesh.edges,
    3: lambda mesh: mesh.triangles,
    4: lambda mesh: mesh.hinges,
}


def stencils(term, state="random", scale=1.0, dtype="float64", device="cpu"):
    """All elements of an irregular mesh of size ``scale`` [m] in a state, each with its own stiffness."""
    random, mesh = np.random.default_rng(1), rest_mesh()
    indices = ON_MESH[term.vertices](mesh)
    x = STATES[state](mesh.points) + random.normal(scale=0.03, size=mesh.points.shape)
    # Places in the precision of the test and round numbers of it, so that both precisions see the same ones.
    x, points = (scale * np.round(values, 4) for values in (x, mesh.points))
    stiffness = random.uniform(0.5, 2.0, len(indices))
    return Stencils(term, x[indices].astype(dtype), rest_state(term, points, indices), stiffness, dtype, device)


def smallest_length(x):
    """Of each stencil (E,): the shortest edge, and of hinges the smallest height over the shared edge [m]."""
    if x.shape[1] == 1:
        return np.ptp(x[:, 0], axis=0).max() * np.ones(len(x))
    lengths = [np.linalg.norm(x[:, i] - x[:, j], axis=1) for i in range(x.shape[1]) for j in range(i)]
    if x.shape[1] == 4:
        e = (x[:, 1] - x[:, 0]) / np.linalg.norm(x[:, 1] - x[:, 0], axis=1)[:, None]
        lengths = lengths[:-1] + [np.linalg.norm(np.cross(e, x[:, i] - x[:, 0]), axis=1) for i in (2, 3)]
    return np.min(lengths, axis=0)


def active(elements):
    """Of each stencil (E,), whether it has energy: a limit has none within its range."""
    found = elements.energy() > 0.0
    if elements.term.name not in LIMITS:
        assert found.all()
    assert found.any()
    return found


def norms(values):
    """‖·‖ of each element, (E,)."""
    return np.sqrt((np.asarray(values, dtype=np.float64) ** 2).reshape(len(values), -1).sum(axis=1))


# --- derivatives


def central_difference(function, x, step):
    """∂function/∂x by central differences: x (E, n), step (E,) → (E, …, n)."""
    columns = []
    for i in range(x.shape[1]):
        change = np.zeros_like(x)
        change[:, i] = step
        difference = function(x + change) - function(x - change)
        columns.append(difference / (2.0 * step).reshape(-1, *[1] * (difference.ndim - 1)))
    return np.stack(columns, axis=-1)


# The step eps^⅓ ℓ balances rounding, eps·f/step, against what a central difference neglects, step²·f‴/6: both are about
# eps^⅔ of f/ℓ. With f‴ ≤ 10 f/ℓ³ in these states, the factor covers both.
DIFFERENCES = 20 * eps("float64") ** (2 / 3)


@every_term
@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("scale", SCALES)
def test_derivatives_are_differences(term, state, scale, device):
    elements = stencils(term, state, scale, device=device)
    E, n = len(elements.x), elements.x[0].size
    x, length = elements.x.reshape(E, n), smallest_length(elements.x)
    energy, gradient, hessian = elements.energy(), elements.gradient().reshape(E, n), elements.hessian()
    stiff = norms(hessian)

    step = eps("float64") ** (1 / 3) * length
    by_difference = central_difference(lambda x: elements.at(x.reshape(E, -1, 3)).energy(), x, step)
    tolerance = DIFFERENCES * (stiff * length + norms(gradient) + energy / length)
    assert (norms(gradient - by_difference) <= tolerance).all()
    by_difference = central_difference(lambda x: elements.at(x.reshape(E, -1, 3)).gradient().reshape(E, n), x, step)
    # A strain limit with one stretch beyond it turns over the difference of the stretches, which is smaller than they are.
    sharpness = 4.0 if term.name == "StrainLimit" else 1.0
    tolerance = sharpness * DIFFERENCES * (stiff + norms(gradient) / length)
    assert (norms(hessian - by_difference) <= tolerance).all()

    # Nothing above is zero by accident, in any element: an energy that is switched off at small scales would pass.
    on = active(elements)
    assert (energy > 1e-8 * stiff * length**2)[on].all() and (norms(gradient) > 1e-4 * stiff * length)[on].all()
    assert (stiff > 0.1 * elements.weights()[1] * elements.stiffness * (1.0 if term.rows == 1 else length**-2))[on].all()
    assert (norms(gradient) == 0.0)[~on].all() and (stiff == 0.0)[~on].all()


@pytest.mark.parametrize("term", **quick(CATALOGUE))
@pytest.mark.parametrize("scale", [*SCALES, 1e-5])
def test_single_precision_rounds_double(term, scale, device):
    """float32 gives the float64 numbers to the rounding of y, at every scale."""
    single, double = (stencils(term, "random", scale, dtype, device) for dtype in ("float32", "float64"))
    double = double.at(single.x)
    size = np.abs(double.x).max()
    # y is rounded by eps|x|; a function f of y then by eps|x|·f′, and by a few eps of itself. f″ is about 10 f′/ℓ.
    stiff, length = norms(double.hessian()), smallest_length(double.x)
    error = FEW * eps("float32") * size
    assert (abs(single.energy() - double.energy()) <= error * (norms(double.gradient()) + stiff * error)).all()
    assert (norms(single.gradient() - double.gradient()) <= error * stiff).all()
    for policy in HessianPolicy:
        assert (norms(single.hessian(policy) - double.hessian(policy)) <= 10 * error * stiff / length).all()


@pytest.mark.parametrize("term", **quick(CATALOGUE))
def test_a_correction_is_a_move(term, device, dtype="float64"):
    """At x corrected by d all is as at x + d; Hessians of each number of vertices, whose kernels take long to compile."""
    elements = stencils(term, "random", 1.0, dtype, device)
    correction = np.random.default_rng(10).normal(scale=0.03, size=elements.x.shape).astype(dtype)
    moved = elements.at(elements.x + correction)
    stiff, length = norms(moved.hessian()), smallest_length(moved.x)
    rounding = FEW * eps(dtype) * np.abs(moved.x).max()
    error, force = rounding * stiff, norms(moved.gradient())
    assert (norms(elements.gradient(correction) - moved.gradient()) <= error).all()
    assert (abs(elements.energy(correction) - moved.energy()) <= rounding * (force + error)).all()
    if term.name in QUICK:
        assert (norms(elements.hessian(RAW, correction) - moved.hessian()) <= 10 * error / length).all()
    on = active(elements) | active(moved)
    assert (norms(elements.gradient() - moved.gradient()) > error)[on].all(), "the correction is well above rounding"


# --- rest


@every_term
@every_dtype
@pytest.mark.parametrize("scale", SCALES)
def test_no_force_at_rest(term, scale, dtype, device):
    """An irregular flat sheet at rest: y is rounded by eps|x|, so the force by the Hessian times that."""
    points = scale * np.round(rest_mesh().points * [1.0, 0.0, 1.0], 4)
    indices = ON_MESH[term.vertices](rest_mesh())
    rest, stiffness = rest_state(term, points, indices), np.ones(len(indices))
    elements = Stencils(term, points[indices].astype(dtype), rest, stiffness, dtype, device)
    error = FEW * eps(dtype) * np.abs(points).max() * norms(elements.hessian())
    assert (norms(elements.gradient()) <= error).all() and ((error > 0.0).all() or term.name in LIMITS)


def test_both_bending_energies_are_one_at_small_angles(device):
    """A flat hinge of any shape, bent by θ: ½c|e|²θ²/(A₁ + A₂) to second order in θ."""
    angle, random = 0.01, np.random.default_rng(11)
    flat = EQUILATERAL + random.normal(scale=0.1, size=(50, 4, 3)) * [1.0, 1.0, 0.0]
    e, arm = unit(flat[:, 1] - flat[:, 0]), flat[:, 3] - flat[:, 0]
    foot, bent = np.sum(arm * e, axis=1, keepdims=True) * e, flat.copy()
    bent[:, 3] = flat[:, 0] + foot + np.cos(angle) * (arm - foot) + np.sin(angle) * np.cross(e, arm - foot)
    indices = np.arange(200).reshape(50, 4)
    areas = sum(0.5 * np.linalg.norm(np.cross(flat[:, 1] - flat[:, 0], flat[:, i] - flat[:, 0]), axis=1) for i in (2, 3))
    expected = 0.5 * 2.0 * np.sum((flat[:, 1] - flat[:, 0]) ** 2, axis=1) / areas * angle**2
    for term in map(term_of, BENDING):
        energy = Stencils(term, bent, rest_state(term, flat.reshape(-1, 3), indices), np.full(50, 2.0), device=device).energy()
        assert (abs(energy - expected) <= angle**2 * expected).all()


@every_dtype
def test_a_collapsing_spring_still_pushes(dtype, device):
    """Its force is k L however short it is; at l = 0 there is no direction, and none."""
    lengths, rest_length = np.array([1e-2, 1e-6, 1e-11, 0.0]), 2.0
    x = on_line(lengths, 1.0)[0].astype(dtype)
    elements = Stencils(term_of("Spring"), x, np.full((4, 1), rest_length), np.full(4, 3.0), dtype, device)
    expected = 3.0 * (lengths - rest_length) * (lengths > 0.0)
    assert np.allclose(elements.gradient()[:, 1, 1], expected, rtol=FEW * eps(dtype), atol=0.0)


# --- invariance


@invariant
@every_dtype
@pytest.mark.parametrize("state", STATES)
def test_moving_the_whole_costs_nothing(term, state, dtype, device):
    elements, random = stencils(term, state, 1.0, dtype, device), np.random.default_rng(2)
    rotation, shift = random_rotation(random), random.normal(size=3)
    energy, gradient, stiff = elements.energy(), norms(elements.gradient()), norms(elements.hessian())
    for moved in (elements.x + shift, elements.x @ rotation.T, elements.x @ rotation.T + shift):
        # Every coordinate is rounded by eps|x|, which costs that times the force, and the force changes with the Hessian.
        error = FEW * eps(dtype) * np.abs(moved).max()
        assert (abs(elements.at(moved).energy() - energy) <= error * (gradient + stiff * error)).all()


@invariant
@every_dtype
@pytest.mark.parametrize("state", STATES)
def test_no_total_force_and_torque(term, state, dtype, device):
    elements = stencils(term, state, 1.0, dtype, device)
    x = elements.x.astype(np.float64)
    arm = x - x.mean(axis=1, keepdims=True)
    force, stiff = elements.gradient().astype(np.float64), norms(elements.hessian())
    # y is rounded by eps|x| and the force by the Hessian times that; the weights sum to zero within eps of themselves.
    error = FEW * eps(dtype) * np.abs(x).max() * stiff
    assert (norms(force.sum(axis=1)) <= error).all()
    assert (norms(np.cross(arm, force).sum(axis=1)) <= error * norms(arm)).all()
    assert (norms(force) > 100.0 * error).any(), "forces are well above rounding"


@every_term
@pytest.mark.parametrize("policy", HessianPolicy, ids=lambda policy: policy.name)
def test_hessian_turns_with_the_stencil(term, policy, device):
    elements, rotation = stencils(term, "random", device=device), random_rotation(np.random.default_rng(3))
    turn, turned = np.kron(np.eye(term.vertices), rotation), elements.at(elements.x @ rotation.T)
    if term.vertices == 1:  # the world turns too: a target, or a normal and a distance
        turned = turned._replace(rest=np.column_stack([elements.rest[:, :3] @ rotation.T, elements.rest[:, 3:]]))
    hessian = elements.hessian(policy)
    # Rounding of y by eps|x| against the smallest length, on which f″ depends.
    tolerance = FEW * eps("float64") * norms(hessian) * np.abs(elements.x).max() / smallest_length(elements.x)
    assert (norms(turned.hessian(policy) - turn @ hessian @ turn.T) <= tolerance).all()


# --- projections and constraints


def in_planes(points, rest):
    """The points of planes nearest to some points, (E, 3)."""
    for _ in range(2):  # the second takes what the first rounded
        distance = np.einsum("ij,ij->i", points, rest[:, :3]) - rest[:, 3]
        points = points - distance[:, None] * rest[:, :3]
    return points


# For each term with a projection: random points of the set that it projects on, (rest (E, P), random) → (E, M, 3).
SETS = {
    "Spring": lambda rest, random: rest[:, None] * unit(random.normal(size=(len(rest), 1, 3))),
    "Plane": lambda rest, random: in_planes(random.normal(size=(len(rest), 3)), rest)[:, None],
    "SpringLimit": lambda rest, random: between(*rest.T, random)[:, None, None] * unit(random.normal(size=(len(rest), 1, 3))),
    "CorotatedMembrane": lambda rest, random: isometries(len(rest), random),
    "StrainLimit": lambda rest, random: stretched(isometries(len(rest), random), *rest[:, 3:].T, random),
    "QuadraticBending": lambda rest, random: np.zeros((len(rest), 1, 3)),
    "DampedQuadraticBending": lambda rest, random: rest[:, 5:, None] * unit(random.normal(size=(len(rest), 1, 3))),
    "Attachment": lambda rest, random: rest[:, None],
}


def between(least, most, random):
    return least + (most - least) * np.clip(random.uniform(-0.5, 1.5, len(least)), 0.0, 1.0)


def isometries(count, random):
    """Pairs of orthonormal rows, (count, 2, 3)."""
    return np.linalg.qr(random.normal(size=(count, 3, 2)))[0].transpose(0, 2, 1)


def stretched(rows, least, most, random):
    """Orthonormal rows mixed by symmetric matrices with eigenvalues in the range."""
    values = np.stack([between(least, most, random) for _ in range(2)], axis=1)
    axes = np.linalg.qr(random.normal(size=(len(rows), 2, 2)))[0]
    return axes * values[:, None] @ axes.transpose(0, 2, 1) @ rows


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


@projecting
@every_dtype
@pytest.mark.parametrize("state", STATES)
def test_projection_gives_the_energy(term, state, dtype, device):
    elements = stencils(term, state, 1.0, dtype, device)
    y, (weights, measures) = elements.y(), elements.weights()
    p, scale = elements.projection(y), elements.stiffness * measures
    error = FEW * eps(dtype) * np.abs(elements.x).max() * np.abs(weights).max(axis=(1, 2))
    distance = norms(y - p)
    assert (abs(elements.energy() - 0.5 * scale * distance**2) <= scale * error * (distance + error)).all()
    force = scale[:, None, None] * np.einsum("ekm,emc->ekc", weights, y - p)
    assert (norms(elements.gradient() - force) <= scale * error * norms(weights)).all()


@projecting
@every_dtype
def test_projection_is_the_nearest_point(term, dtype, device):
    random, elements = np.random.default_rng(4), stencils(term, "random", 1.0, dtype, device)
    y = elements.y()
    p = elements.projection(y)
    error = FEW * eps(dtype) * (norms(y) + norms(p))
    assert (norms(elements.projection(p) - p) <= error).all()
    for _ in range(100):
        q = SETS[term.name](elements.rest, random)
        assert (norms(elements.projection(q) - q) <= FEW * eps(dtype) * norms(q)).all(), "q is a point of the set"
        assert (norms(y - p) <= norms(y - q) + error).all()


either_way = pytest.mark.parametrize("hard", [True, False], ids=["hard", "soft"])


def some_pinned(elements):
    """Inverse masses (E, K), of which a few are 0."""
    inverse_mass = np.random.default_rng(5).uniform(0.5, 2.0, elements.x.shape[:2])
    inverse_mass[::3, 0] = 0.0
    return inverse_mass


@projecting
@every_dtype
@either_way
def test_correction_solves_the_local_step(term, dtype, hard, device):
    """y moves by G W Gᵀ(G W Gᵀ + α̃)⁻¹ of the way to p(y), α̃ = 1/(k A h²); momentum stays."""
    elements = stencils(term, "random", 1.0, dtype, device)
    inverse_mass, h = some_pinned(elements), 0.1
    elements = elements.hard() if hard else elements
    weights, measures = elements.weights()
    change, y = elements.correction(inverse_mass, h), elements.y()
    system = np.einsum("ekm,ek,ekn->emn", weights, inverse_mass, weights, dtype=np.float64)
    softness = np.eye(term.rows) / (elements.stiffness * measures * h * h)[:, None, None]
    movable = inverse_mass.any(axis=1)
    assert (change[inverse_mass == 0.0] == 0.0).all()
    rows = np.linalg.solve((system + softness)[movable], (elements.projection(y) - y)[movable])
    expected = np.einsum("ek,ekm,emc->ekc", inverse_mass[movable], weights[movable], rows)
    error = FEW * eps(dtype) * np.abs(elements.x).max() * np.abs(weights[movable]).sum(axis=(1, 2))
    spread = norms(inverse_mass[movable][..., None] * weights[movable]) * norms(np.linalg.inv((system + softness)[movable]))
    assert (norms(change[movable] - expected) <= error * spread).all()
    above = norms(expected) > 100 * error * spread
    assert above[active(elements)[movable]].mean() > 0.9, "corrections are well above rounding"


@pytest.mark.parametrize("term", **named([term for term in CATALOGUE if term.moves]))
@every_dtype
def test_without_stiffness_nothing_is_corrected(term, dtype, device):
    elements = stencils(term, "random", 1.0, dtype, device)
    loose = elements._replace(stiffness=np.zeros(len(elements.x)))
    assert (loose.correction(np.ones(elements.x.shape[:2]), 0.1) == 0.0).all()


@every_dtype
@either_way
@pytest.mark.parametrize("name", ["CorotatedMembrane", "StrainLimit"])
def test_two_pins_leave_one_vertex_its_best_place(name, hard, dtype, device):
    """With one free vertex of a triangle Fᵀ moves along one direction only: to the least ‖F − p‖ there is, for a hard one."""
    elements, free = stencils(term_of(name), "compressed", 1.0, dtype, device), 2
    inverse_mass = np.zeros(elements.x.shape[:2])
    inverse_mass[:, free] = 3.0
    elements = elements.hard() if hard else elements
    weights, measures = (values.astype(np.float64) for values in elements.weights())
    change, y, h = elements.correction(inverse_mass, 0.1), elements.y(), 0.1
    assert (change[:, :free] == 0.0).all()
    w, softness = weights[:, free], 1.0 / (elements.stiffness * measures * h * h)
    wanted = np.einsum("em,emc->ec", w, elements.projection(y) - y)
    expected = 3.0 * wanted / (3.0 * np.sum(w * w, axis=1) + softness)[:, None]
    # Where α̃ is small beside G W Gᵀ, 1/α̃ enlarges rounding of what no vertex can move, but no vertex moves by it.
    assert (norms(change[:, free] - expected) <= 10 * FEW * eps(dtype) * (np.abs(elements.x).max() + norms(expected))).all()
    assert (norms(expected) > 0.0).any()


@constraining
@every_dtype
@either_way
def test_scalar_correction_solves_the_linear_step(term, dtype, hard, device):
    """Δx = −W ∂C C/(∂Cᵀ W ∂C + α̃) where the term has no projection; with one, that of the projection is the same."""
    elements = stencils(term, "random", 1.0, dtype, device)
    inverse_mass, h = some_pinned(elements), 0.1
    elements = elements.hard() if hard else elements
    (weights, measures), y = elements.weights(), elements.y()
    c, gradient, _ = elements.constraint(y)
    direction = np.einsum("ekm,emc->ekc", weights, gradient.reshape(y.shape), dtype=np.float64)
    system = np.einsum("ek,ekc,ekc->e", inverse_mass, direction, direction)
    multiplier = -c / (system + 1.0 / (elements.stiffness * measures * h * h))
    expected = (inverse_mass * multiplier[:, None])[..., None] * direction
    change = elements.correction(inverse_mass, h)
    assert (change[inverse_mass == 0.0] == 0.0).all()
    # Rounding of y by eps|x| changes C, ∂C and both factors by that over the smallest length, relatively.
    error = FEW * eps(dtype) * np.abs(elements.x).max() / smallest_length(elements.x)
    size = norms(direction * inverse_mass[..., None]) * (1.0 + abs(c) / norms(gradient) / smallest_length(elements.x))
    assert (norms(change - expected) <= error * size * norms(gradient) * smallest_length(elements.x) / system).all()
    assert (norms(expected) > 0.0).all()


@constraining
@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("scale", SCALES)
def test_constraint_gives_the_energy(term, state, scale, device):
    elements = stencils(term, state, scale, device=device)
    y, (weights, measures) = elements.y(), elements.weights()
    E, n = len(y), y[0].size
    c, first, second = elements.constraint(y)
    strength, to_x = elements.stiffness * measures, np.einsum("ekm,cd->ekcmd", weights, np.eye(3)).reshape(E, -1, n)
    # y is summed here and in the kernel in another order: rounding eps|x| against the smallest length.
    length = smallest_length(elements.x)
    error = FEW * eps("float64") * np.abs(elements.x).max() / length
    stiff, u = norms(elements.hessian()), elements.energy()
    assert (abs(u - 0.5 * strength * c**2) <= error * (u + stiff * length**2)).all()
    gradient = elements.gradient().reshape(E, -1)
    assert (norms(gradient - (strength * c)[:, None] * np.einsum("eij,ej->ei", to_x, first)) <= error * stiff * length).all()
    hessian = first[:, :, None] * first[:, None] + c[:, None, None] * second
    hessian = strength[:, None, None] * (to_x @ hessian @ to_x.transpose(0, 2, 1))
    assert (norms(elements.hessian() - hessian) <= 10 * error * stiff).all()

    def of(i):
        return lambda values: elements.constraint(values.reshape(y.shape))[i]

    step = eps("float64") ** (1 / 3) * length
    by_difference = central_difference(of(0), y.reshape(E, n), step)
    tolerance = DIFFERENCES * (abs(c) / length + norms(first) + norms(second) * length)
    assert (norms(first - by_difference) <= tolerance).all()
    by_difference = central_difference(of(1), y.reshape(E, n), step)
    assert (norms(second - by_difference) <= DIFFERENCES * (norms(first) / length + norms(second))).all()
    assert (norms(first) * length > 0.01 * abs(c)).all() and (norms(second) > 0.0).all()


# --- policies of the Hessian


@every_term
@every_dtype
@pytest.mark.parametrize("state", STATES)
def test_policies_are_semidefinite(term, state, dtype, device):
    elements = stencils(term, state, 1.0, dtype, device)
    raw, clamp, absolute = (elements.hessian(policy).astype(np.float64) for policy in HessianPolicy)
    # A matrix whose entries are rounded by eps has eigenvalues that are off by eps‖H‖.
    error = FEW * eps(dtype) * norms(absolute)

    def lowest(matrices):
        return np.linalg.eigvalsh(0.5 * (matrices + matrices.transpose(0, 2, 1)))[:, 0]

    for matrices in (raw, clamp, absolute):
        assert (norms(matrices - matrices.transpose(0, 2, 1)) <= error).all()
    # 0 ≤ clamp ≤ absolute, and both ≥ ±raw: they bound the energy from above to second order.
    for matrices in (clamp, clamp - raw, absolute - clamp, absolute + raw):
        assert (lowest(matrices) >= -error).all()
    semidefinite = lowest(raw) >= -error
    assert (norms(clamp - raw)[semidefinite] <= error[semidefinite]).all()
    assert (norms(absolute - raw)[semidefinite] <= error[semidefinite]).all()
    assert (norms(clamp - raw)[~semidefinite] > error[~semidefinite]).all()
    assert (norms(elements.hessian(0.25) - 0.25 * raw - 0.75 * clamp) <= error).all()
    if term.name == "Spring" and state == "random":
        assert semidefinite.any() and not semidefinite.all(), "both kinds are tested"


def in_each_precision(names):
    """Names in float64, and one of them in float32 too, whose kernel differs by the type alone."""
    given = [(name, "float64") for name in names]
    return pytest.mark.parametrize(("name", "dtype"), slow_but(given, [*given, ("NeoHookeanMembrane", "float32")]))


@in_each_precision([name for name in MEMBRANES if name != "OrthotropicMembrane"])  # which bounds them
@pytest.mark.parametrize("state", STATES)
def test_policies_of_membranes_are_those_of_the_eigenvalues(name, state, dtype, device):
    """∂²u/∂F² with its negative eigenvalues dropped or turned: at their places, at random F, and where σ₁ = σ₂."""
    elements, random = stencils(term_of(name), state, 1.0, dtype, device), np.random.default_rng(12)
    E = len(elements.x)
    sizes, rows = random.uniform(0.3, 2.0, (E, 1, 1)), isometries(E, random)
    for y in (elements.y(), random.normal(size=(E, 2, 3)), sizes * rows, np.array([[[2.0], [1e-3]]]) * rows, rows):
        raw, clamp, absolute = (elements.second_derivative(y, policy).astype(np.float64) for policy in HessianPolicy)
        values, vectors = np.linalg.eigh(0.5 * (raw + raw.transpose(0, 2, 1)))
        error = FEW * eps(dtype) * norms(raw)
        for policy, found in ((np.maximum(values, 0.0), clamp), (abs(values), absolute)):
            expected = (vectors * policy[:, None]) @ vectors.transpose(0, 2, 1)
            assert (norms(found - expected) <= error).all()
        negative = values[:, 0] < -error
        assert (norms(clamp - raw)[negative] > 0.0).all()
    assert negative.sum() == 0, "an isometry has no negative curvature"


@every_dtype
def test_policies_of_a_compressed_spring(dtype, device):
    """At l = 0.8 L the transverse eigenvalue is k(1 − L/l) = −k/4 twice; l = 1, L = 1.25 and k = 8 are exact."""
    x = np.array([[[0.0, 0.0, 0.0], [0.0, 1.0, 0.0]]], dtype=dtype)
    elements = Stencils(term_of("Spring"), x, np.array([[1.25]]), np.array([8.0]), dtype, device)
    for policy, transverse in ((RAW, -2.0), (CLAMP, 0.0), (ABSOLUTE, 2.0)):
        one_end_fixed = elements.hessian(policy)[0, :3, :3]
        assert np.linalg.eigvalsh(one_end_fixed).tolist() == sorted([transverse, transverse, 8.0])


@every_term
@every_dtype
def test_policies_agree_at_rest(term, dtype, device):
    """At the rest state no energy has negative curvature, but rounding of y by eps|x| gives that part of the next order."""
    mesh = rest_mesh()
    indices = ON_MESH[term.vertices](mesh)
    rest, stiffness = rest_state(term, mesh.points, indices), np.ones(len(indices))
    elements = Stencils(term, mesh.points[indices].astype(dtype), rest, stiffness, dtype, device)
    raw, clamp, absolute = (elements.hessian(policy) for policy in HessianPolicy)
    error = FEW * eps(dtype) * norms(raw) / smallest_length(elements.x)
    assert (norms(clamp - raw) <= error).all() and (norms(absolute - raw) <= error).all()


# Orders of the vertices of a stencil that mean the same element, by the number of vertices.
SAME_ELEMENT = {1: [(0,)], 2: [(1, 0)], 3: [(1, 2, 0), (0, 2, 1), (2, 1, 0)], 4: [(1, 0, 3, 2), (1, 0, 2, 3), (0, 1, 3, 2)]}


@every_term
@pytest.mark.parametrize("policy", HessianPolicy, ids=lambda policy: policy.name)
@pytest.mark.parametrize("state", STATES)
def test_order_of_a_stencil_is_no_matter(term, policy, state, device):
    elements, mesh = stencils(term, state, device=device), rest_mesh()
    indices, length, hessian = ON_MESH[term.vertices](mesh), smallest_length(elements.x), elements.hessian(policy)
    # Rounding of y by eps|x| against the smallest length, on which f″ depends.
    error = FEW * eps("float64") * np.abs(elements.x).max() / length * norms(elements.hessian(ABSOLUTE))
    for order in map(list, SAME_ELEMENT[term.vertices]):
        rest = rest_state(term, np.round(mesh.points, 4), indices[:, order])
        swapped = elements.at(elements.x[:, order])._replace(rest=rest)
        rows = (3 * np.array(order)[:, None] + np.arange(3)).ravel()
        assert (norms(swapped.hessian(policy) - hessian[:, rows][:, :, rows]) <= error).all()
        assert (norms(swapped.gradient() - elements.gradient()[:, order]) <= error * length).all()
        assert (abs(swapped.energy() - elements.energy()) <= error * length**2).all()


# --- closed forms of membranes


def on_one_triangle(name, F, dtype, device, **material):
    """Places of a unit right triangle with the deformation gradients F (E, 3, 2), of stiffness 1."""
    term, count = term_of(name), len(F)
    rest = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    x = np.einsum("eij,kj->eki", F, rest[:, :2])
    state = term.rest_state(np.tile(rest, (count, 1)), np.arange(3 * count).reshape(count, 3), **material)
    return Stencils(term, x.astype(dtype), state, np.ones(count), dtype, device)


@every_dtype
@pytest.mark.parametrize("ratio", [0.0, 0.3, 0.49, -0.5, 0.95])
@pytest.mark.parametrize("name", DENSITIES)
def test_energy_of_stretches_and_of_simple_shear(name, ratio, dtype, device):
    """Simple shear γ has the stretches √(1 + γ²/4) ± γ/2."""
    shear = np.array([0.0, 1e-3, 0.1, 1.0, 3.0])
    F = np.zeros((len(shear) + 3, 3, 2))
    F[:, 0, 0] = F[:, 1, 1] = 1.0
    F[: len(shear), 0, 1] = shear
    F[len(shear) :, 0, 0], F[len(shear) :, 1, 1] = (0.5, 2.0, 1.0), (0.25, 0.75, 3.0)
    long = np.append(np.sqrt(1.0 + shear**2 / 4.0) + shear / 2.0, [0.5, 2.0, 3.0])
    short = np.append(np.sqrt(1.0 + shear**2 / 4.0) - shear / 2.0, [0.25, 0.75, 1.0])
    given, mu, lam = material_of(name, ratio)
    elements = on_one_triangle(name, F, dtype, device, **given)
    expected = 0.5 * DENSITIES[name](long, short, mu, lam)
    # F is rounded by eps, and the strain with it, which is squared in u; the reference cancels in double precision.
    error, force = FEW * eps(dtype) * long, norms(elements.gradient())
    assert (abs(elements.energy() - expected) <= error * (force + (mu + lam + 1.0) * error) + FEW * eps("float64")).all()


@in_each_precision(DENSITIES)
@pytest.mark.parametrize("ratio", [0.0, 0.3, 0.49, -0.5, 0.95])
def test_small_strain_is_linear_elasticity(name, ratio, dtype, device):
    """At rest ∂²u = 2με:ε + λ(tr ε)² in the plane and 0 out of it, ε the symmetric part of ∂F."""
    given, mu, lam = material_of(name, ratio)
    elements = on_one_triangle(name, np.eye(3, 2)[None], dtype, device, **given)
    strain = np.zeros((2, 2, 6))  # of y row by row: columns f₁, f₂ of F
    strain[0, 0, 0] = strain[1, 1, 4] = 1.0
    strain[0, 1, [1, 3]] = strain[1, 0, [1, 3]] = 0.5
    trace = strain[0, 0] + strain[1, 1]
    expected = 2.0 * mu * np.einsum("ija,ijb->ab", strain, strain) + lam * np.outer(trace, trace)
    assert (abs(elements.second_derivative(elements.y(), RAW)[0] - expected) <= FEW * eps(dtype) * (2.0 * mu + lam)).all()


@every_dtype
def test_a_crushed_triangle_is_pushed_apart(dtype, device):
    """The Neo-Hookean force on a nearly collapsed side does not vanish, in whatever direction it is collapsed."""
    F = np.array([[[1.0, 0.0], [0.0, height], [0.0, 0.0]] for height in (1e-2, 1e-4, 1e-5)])
    given, mu, lam = material_of("NeoHookeanMembrane", 0.3)
    elements = on_one_triangle("NeoHookeanMembrane", F, dtype, device, **given)
    expected = 0.5 * (mu * F[:, 1, 1] + (lam + mu) * (F[:, 1, 1] - 1.0) - mu)
    assert np.allclose(elements.gradient()[:, 2, 1], expected, rtol=FEW * eps(dtype))


# --- where an energy is on its edge


def hinge(**moved):
    """The equilateral hinge with some vertices elsewhere."""
    x = EQUILATERAL.copy()
    for name, place in moved.items():
        x[int(name[1])] = place
    return x


def on_hinge(places):
    return places, np.broadcast_to(EQUILATERAL, places.shape)


ISOSCELES = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.5, 0.3, 0.4]])


def on_triangle(*places):
    places = np.concatenate(places)
    return places, np.broadcast_to(EQUILATERAL[:3], places.shape)


def on_line(lengths, rest_lengths):
    places = np.zeros((len(lengths), 2, 3))
    places[:, 1, 1] = lengths
    rest = np.zeros_like(places)
    rest[:, 1, 2] = rest_lengths
    return places, rest


# Places (E, K, 3) and rest places (E, K, 3), for a rest size of 1; by the number of vertices.
EDGES = {
    1: {
        "at its target": (np.zeros((1, 1, 3)), np.zeros((1, 1, 3))),
        "very far": (np.full((1, 1, 3), 1e9), np.zeros((1, 1, 3))),
    },
    2: {
        "collapsed": on_line([0.0, 1e-20, 1e-30, 1e-13, 1e-11], 5 * [1.0]),
        "without a rest length": on_line([0.0, 1e-20, 1e-30, 1e-3, 1.0], 5 * [0.0]),
    },
    3: {
        "in one point": on_triangle(np.zeros((1, 3, 3)), np.ones((1, 3, 3))),
        "on one line": on_triangle(
            np.array([[[0, 0, 0], [1, 0, 0], [x, y, 0]] for x in (-1.0, 0.0, 0.3, 0.5, 1.0) for y in (0.0, 1e-20, 1e-9, 1e-6)])
        ),
        "tiny": on_triangle(*(size * ISOSCELES[None] for size in (1e-30, 1e-20, 1e-12, 1e-5)), 1e-20 * EQUILATERAL[None, :3]),
        "at rest": on_triangle(EQUILATERAL[None, :3], EQUILATERAL[None, [0, 2, 1]], EQUILATERAL[None, [1, 0, 2]]),
        "stretched alike": on_triangle(*(size * EQUILATERAL[None, :3] for size in (0.1, 0.9, 1.05, 2.0, 1e3))),
    },
    4: {
        "slivers": on_hinge(
            np.array(
                [
                    hinge(**{corner: [along, 0.6 * sign * height, 0.8 * height]})
                    for corner, sign in (("x2", 1.0), ("x3", -1.0))
                    for along in (0.5, 0.0, 1.0, 3.0, -2.0)
                    for height in (1e-5, 2e-6, 1e-7, 1e-12)
                ]
                + [hinge(x2=[0.5, 1e-5, 0.0], x3=[0.5, 0.0, 1e-7]), hinge(x2=[0.5, 1e-7, 0.0], x3=[0.5, 0.0, 1e-7])]
            )
        ),
        "short edges": on_hinge(np.array([hinge(x1=[length, 0.0, 0.1 * length]) for length in (1e-5, 1e-7, 1e-12, 1e-20)])),
        "folded flat": on_hinge(
            np.array([hinge(x3=[0.5, HALF, bit]) for bit in (0.0, 1e-12, -1e-12, 1e-7, -1e-7)] + [hinge(x3=[0.2, 0.4, 0.0])])
        ),
        "on one line": on_hinge(np.array([hinge(x2=[2.0, 0.0, 0.0]), hinge(x2=[0.5, 0.0, 0.0], x3=[0.2, 0.0, 0.0])])),
        "in one point": on_hinge(
            np.array(
                [
                    *(np.zeros((4, 3)), np.ones((4, 3)), hinge(x1=EQUILATERAL[0]), hinge(x2=EQUILATERAL[0])),
                    *(hinge(x3=EQUILATERAL[1]), hinge(x2=EQUILATERAL[0], x3=EQUILATERAL[1])),
                    hinge(x1=EQUILATERAL[0], x2=EQUILATERAL[0]),
                ]
            )
        ),
    },
}
on_edges = pytest.mark.parametrize(
    ("term", "edge"),
    [pytest.param(term, edge, id=f"{term.name}-{edge}") for term in CATALOGUE for edge in EDGES[term.vertices]],
)


def edge_stencils(term, edge, scale, dtype, device):
    places, rest = EDGES[term.vertices][edge]
    rest = rest.reshape(-1, 3) * scale
    state = rest_state(term, rest, np.arange(len(rest)).reshape(places.shape[:2]))
    return Stencils(term, (places * scale).astype(dtype), state, np.ones(len(places)), dtype, device)


@on_edges
@every_dtype
@pytest.mark.parametrize("scale", SCALES)
def test_edges_stay_finite(term, edge, scale, dtype, device):
    elements = edge_stencils(term, edge, scale, dtype, device)
    results = [elements.energy(), elements.gradient(), *(elements.hessian(policy) for policy in HessianPolicy)]
    if term.moves:
        results += [stencil.correction(np.ones(elements.x.shape[:2]), 0.1) for stencil in (elements, elements.hard())]
    if term.project:
        results.append(elements.projection(elements.y()))
    if term.constraint:
        results.extend(elements.constraint(elements.y()))
    assert all(np.isfinite(values).all() for values in results)
    for policy in (CLAMP, ABSOLUTE):
        hessian = elements.hessian(policy).astype(np.float64)
        lost = eps(dtype) * norms(hessian) + np.finfo(dtype).tiny
        assert (np.linalg.eigvalsh(hessian)[:, 0] >= -FEW * lost).all()


@on_edges
def test_order_is_no_matter_at_edges(term, edge, device):
    elements = edge_stencils(term, edge, 1.0, "float64", device)
    places, rest = EDGES[term.vertices][edge]
    energy, force = elements.energy(), norms(elements.gradient())
    # Rounding of the places against the smallest height that has a normal. (The sign of a half turn is free.)
    error = FEW * eps("float64") / 1e-6
    for order in SAME_ELEMENT[term.vertices]:
        indices = np.arange(len(places) * term.vertices).reshape(len(places), -1)[:, list(order)]
        swapped = elements.at(places[:, list(order)])._replace(rest=rest_state(term, rest.reshape(-1, 3), indices))
        assert (abs(swapped.energy() - energy) <= error * energy.max() + (FEW * eps("float64")) ** 2).all()
        assert (abs(norms(swapped.gradient()) - force) <= error * np.maximum(force, 1.0)).all()


@every_term
@every_dtype
def test_nan_is_never_swallowed(term, dtype, device):
    """A vertex that is not a number makes the energy, the force and the correction of its stencil not a number."""
    cases = [stencils(term, "random", 1.0, dtype, device)]
    cases += [edge_stencils(term, edge, 1.0, dtype, device) for edge in EDGES[term.vertices]]
    for elements in cases:
        for corner in range(term.vertices):
            for coordinate in range(3):
                x = elements.x.copy()
                x[:, corner, coordinate] = np.nan
                broken = elements.at(x)
                assert np.isnan(broken.energy()).all() and np.isnan(broken.gradient()).any(axis=(1, 2)).all()
                if term.moves:
                    assert np.isnan(broken.correction(np.ones(x.shape[:2]), 0.1)).any(axis=(1, 2)).all()


# --- sums over a mesh


def row_sums(model):
    """Σ‖Hᵢⱼ‖ of every vertex, element by element, (N,): how much rounding of the places comes back as force."""
    return block_norms(model, model.terms, model.positions)


@pytest.mark.parametrize("term", **named(DECLARABLE))
def test_numbering_of_the_mesh_is_no_matter(term, device, dtype="float64"):
    random, mesh = np.random.default_rng(7), rest_mesh()
    n = len(mesh.points)
    x, new = mesh.points + random.normal(scale=0.03, size=(n, 3)), random.permutation(n)
    old = np.argsort(new)
    triangles = new[np.array([np.roll(corners, random.integers(3)) for corners in random.permutation(mesh.triangles)])]
    renumbered = wc.Mesh(mesh.points[old], triangles)
    one, two = (model_of(*given, names=[term.name], dtype=dtype, device=device) for given in ((mesh, x), (renumbered, x[old])))
    (energy, gradient), (energy_again, gradient_again) = energy_and_gradient(one), energy_and_gradient(two)
    rows, size = row_sums(one), np.abs(x).max()
    error = FEW * eps(dtype) * size * rows
    assert (np.linalg.norm(gradient_again[new] - gradient, axis=1) <= error).all()
    assert abs(energy_again[0] - energy[0]) <= FEW * eps(dtype) * (energy[0] + size * np.linalg.norm(gradient, axis=1).sum())
    assert (np.linalg.norm(gradient, axis=1) > 100 * error).any()


# One of each number of vertices and of each way to store incidences (pairs, rows of a matrix, padded or not): these sums have
# no more of a term than its forces, which tests above have. In float32 they are the same loops.
STORED = (*QUICK, "DihedralBending")
GATHERED = [(term, "float64") for term in DECLARABLE if term.name in STORED]
GATHERED += [(term, "float32") for term in DECLARABLE if term.name in ("Spring", "QuadraticBending")]


THERE = np.array([1.0, 2.0, 3.0])


def added(model, kernel, elements, data, gathers, count=1):
    """Vectors to which a kernel that scatters or gathers has added, ``count`` arrays (N, 3)."""
    out = [model.vectors() for _ in range(count)]
    for array in out:
        array.fill_(model.vec3(*THERE))
    given = [*(elements.incidences if gathers else [elements.stencil]), elements.rest, data]
    model.launch(kernel, model.count if gathers else elements.count, given, out)
    return [array.numpy() for array in out]


def gathered_forces(model, part, arrays, kernel=None, there=THERE):
    """Forces ``there`` with what the kernel of fast steps adds for a part."""
    out, given = model.vectors(), [chained([part], [arrays], model.dtype), model.positions, model.vectors()]
    out.fill_(model.vec3(*there))
    model.launch(kernel or gather.gather_forces((part,), model.dtype), model.count, given, [out])
    return out.numpy()


@pytest.mark.parametrize(
    ("term", "dtype"),
    slow_but([(term, "float64") for term in DECLARABLE if term.name in QUICK], GATHERED),
    ids=lambda value: getattr(value, "name", value),
)
def test_gathering_is_scattering(term, dtype, device, monkeypatch):
    """The sum over the stencils of a vertex, the way of a GPU, is the sum over stencils; and each run gives the same bits."""
    # Also that of several threads a vertex: 4 in float32, 3 in float64. The slots of a vertex may be a multiple of them or not.
    monkeypatch.setattr(quadratic, "CHUNK", 7)  # of matrices, which are then added up in several
    random, mesh = np.random.default_rng(8), rest_mesh()
    places = mesh.points + random.normal(scale=0.03, size=mesh.points.shape)
    # Scattering is for one thread, of the CPU.
    model, other = (model_of(mesh, places, [term.name], dtype, each, pins=[0, 7], copies=2) for each in (device, "cpu"))
    part, arrays = gathered(model, model.terms[0])
    scalar = model.dtype

    def sums_of_core(on, factory, gathers=False):
        elements = on.terms[0]
        data = elastic(term, scalar, elements.stencil, elements.stiffness, on.positions, None)
        (out,) = added(on, factory(term, scalar), elements, data, gathers)
        return out

    scattered = sums_of_core(other, assemble.scatter_gradient)
    gathered_in_core = sums_of_core(model, assemble.gather_gradient, gathers=True)
    found, again = (gathered_forces(model, part, arrays) for _ in range(2))
    # Only the order of the sum differs, and the compiler's use of fused multiplication.
    size = np.abs(mesh.points).max() + 1.0
    by_lanes = gradient_by_lanes(part, scalar, 4 if dtype == "float32" else 3)
    for each in (found, gathered_in_core, gathered_forces(model, part, arrays, by_lanes)):
        assert (np.linalg.norm(scattered - each, axis=1) <= FEW * eps(dtype) * (4.0 + size * row_sums(model))).all()
    assert (found == again).all() and (found != THERE).any()


@pytest.mark.parametrize("name", ["Spring", "QuadraticBending"])
@every_dtype
def test_a_copy_gathers_the_bits_of_a_model_of_its_own(name, dtype, device):
    """Be the stiffness one for all or one for each copy, and the elements of copies one after another or mixed."""
    values, found = [3.0, 7.0, 11.0], []
    x = rest_mesh().points + np.random.default_rng(12).normal(scale=0.03, size=rest_mesh().points.shape)
    batch = model_of(rest_mesh(), x, [name], dtype, device, copies=3, vary={f"{name}.stiffness": values})
    elements = batch.terms[0]
    mixed = np.arange(elements.count).reshape(3, -1).T.ravel()  # as colours order them, a copy after another in each
    batches = [(batch, elements), (batch, elements.reordered(mixed))]
    alone = [model_of(rest_mesh(), x, [name], dtype, device, vary={f"{name}.stiffness": [k]}, copies=1) for k in values]
    for k in values:
        scene = wc.Scene(rest_mesh(), density=0.2, positions=x, terms=[getattr(wc, name)(stiffness=k)])
        alone.append(scene.build(device=device, dtype=dtype))
    for model, elements in [*batches, *((model, model.terms[0]) for model in alone)]:
        found.append(gathered_forces(model, *gathered(model, elements), there=(0.0, 0.0, 0.0)))
    for forces in found[:2]:
        for again in (found[2:5], found[5:]):
            assert np.array_equal(forces, np.vstack(again)) and forces.any()


def test_bending_that_gathers_by_element_has_no_net_force(device):
    """But for what the forces of elements are rounded by, which is small beside what the products of a matrix are."""
    # Of a sheet that curves by 0.01 of an edge these are 100 times as large as the force, and what one vertex rounds no other
    # takes back.
    mesh, radius = wc.Mesh.grid(12, 12, size=1.0), 100.0 / 11.0
    x, _y, z = mesh.points.T
    rolled = np.column_stack([radius * np.sin(x / radius), radius * (1.0 - np.cos(x / radius)), z])
    model, nets = model_of(mesh, rolled, ["QuadraticBending"], "float32", device), {}
    for rows in (True, False):
        part, arrays = gathered(model, model.terms[0], rows=rows)
        assert bool(part.rows) == rows
        found = gathered_forces(model, part, arrays, there=(0.0, 0.0, 0.0))
        nets[rows] = np.linalg.norm(found.astype(np.float64).sum(axis=0))
    forces = np.linalg.norm(found, axis=1)
    assert nets[False] <= FEW * eps("float32") * forces.sum() < 0.1 * nets[True]


def elastic(term, dtype, stencil, stiffness, x, d):
    """The arrays that the forces of a term are computed from."""
    data = assemble.elastic(term, dtype)()
    data.stencil, data.stiffness, data.x = stencil, stiffness, x
    if d is not None:
        data.d = d
    return data


def agree(found, dtype):
    """Whether what elements add to THERE in several orders agrees but for rounding, and is not 0."""
    scattered, gathered_ = (each - THERE for each in found)
    return np.abs(scattered).max() > 0.0 and np.abs(gathered_ - scattered).max() <= FEW * eps(dtype) * np.abs(scattered).max()


# One of each number of vertices and of rows: no more of a term is in what these write to the vertices.
WRITTEN = ("Attachment", "Spring", "CorotatedMembrane", "QuadraticBending", "DihedralBending")


@pytest.mark.parametrize("term", **named([term for term in DECLARABLE if term.name in WRITTEN]))
def test_sums_of_splitting_gather_what_they_scatter(term, device, dtype="float64"):
    """Gᵀ of the gaps, the changes and the multipliers of ADMM, added to what is there."""
    found = []
    # Scattering is for one thread, of the CPU.
    for factory, each in ((admm.scatter_admm, "cpu"), (admm.gather_admm, device)):
        model = model_of(rest_mesh(), None, [term.name], dtype, each, pins=[0, 7], copies=2)
        elements = model.terms[0]
        random, matrix = np.random.default_rng(10), wp.types.matrix((term.rows, 3), model.dtype)
        ratio, scale = (model.array(random.uniform(0.5, 2.0, elements.count), model.dtype) for _ in range(2))
        values = [model.array(random.normal(size=(elements.count, term.rows, 3)), matrix) for _ in range(3)]
        of = admm.admm_elements(term, model.dtype)()
        of.stiffness, of.ratio, of.scale = elements.stiffness, ratio, scale
        of.u, of.gap, of.change = values
        found.append(added(model, factory(term, model.dtype), elements, of, factory is admm.gather_admm, 3))
    assert all(agree(both, dtype) for both in zip(*found, strict=True))


ROWS = [
    (term, *key)
    for term in DECLARABLE
    for key in ((False, False), (True, False), (True, True))
    if (term.constraint if key[0] else term.project)
    if term.name in WRITTEN
]


@pytest.mark.parametrize(
    ("term", "scalar", "curved"), ROWS, ids=[f"{term.name}-{scalar}-{curved}" for term, scalar, curved in ROWS]
)
def test_rows_of_constraints_gather_what_they_scatter(term, scalar, curved, device, dtype="float64"):
    """out += Jᵀλ of the copies that are active, by the loops of test_gathering_is_scattering, which takes both precisions."""
    found, rows = [], constrain.row_count(term, scalar, curved)
    for factory, each in ((jacobian.scatter_rows, "cpu"), (jacobian.gather_rows, device)):
        model = model_of(rest_mesh(), None, [term.name], dtype, each, pins=[0, 7], copies=3)
        elements = model.terms[0]
        first, per_copy = 5, rows * elements.per_copy + 7  # rows of other terms before and after
        key = (term, model.dtype, scalar, curved)
        slopes = wp.zeros(elements.count, dtype=constrain.slope_type(*key), device=each)
        random = np.random.default_rng(11)
        slopes.assign(random.normal(size=slopes.numpy().shape))
        lambdas = model.array(random.normal(size=3 * per_copy), model.dtype)
        active, held = wp.array([1, 0, 1], dtype=wp.int32, device=each), jacobian.held_rows(*key)()
        held.slopes, held.multipliers, held.active = slopes, lambdas, active
        held.layout.per_copy, held.layout.first, held.layout.rows_per_copy = elements.per_copy, first, per_copy
        found += added(model, factory(*key), elements, held, factory is jacobian.gather_rows)
    assert agree(found, dtype) and all((each[model.per_copy : 2 * model.per_copy] == THERE).all() for each in found)


def test_hessian_matrix_is_differences_of_the_gradient(device):
    """All terms, pins and two unlike copies: ∂²U/∂x² + s M in the free rows, the identity in the pinned, copies apart."""
    mesh, scale, pins = wc.Mesh.grid(4, 3, pattern="alternating"), 1.7, [0, 5]
    random = np.random.default_rng(9)
    x = mesh.points + random.normal(scale=0.05, size=mesh.points.shape)
    vary = {"Spring.stiffness": [50.0, 20.0], "DihedralBending.stiffness": [0.3, 0.6], "density": [0.2, 0.4]}
    vary |= {f"{name}.stiffness": [50.0, 20.0] for name in MEMBRANES}
    model = model_of(mesh, x, device=device, pins=pins, copies=2, vary=vary)
    hessian, gradient = Hessian(model), Gradient(model)
    hessian.assemble(model.positions, scale)
    matrix = hessian.matrix().toarray()

    def gradient_at(values):
        out = model.vectors()
        gradient.add(model.array(values.reshape(-1, 3), model.vec3), out)
        return out.numpy().reshape(1, -1)

    start, length = model.positions.numpy().reshape(1, -1), mesh.edge_lengths.min()
    expected = central_difference(gradient_at, start, np.array([eps("float64") ** (1 / 3) * length]))[0]
    expected += scale * np.diag(np.repeat(model.mass.numpy(), 3))
    held = np.repeat(np.tile(np.isin(np.arange(len(x)), pins), 2), 3)
    expected[held], expected[:, held] = 0.0, 0.0
    expected[held, held] = 1.0
    tolerance = DIFFERENCES * (np.linalg.norm(expected) + np.linalg.norm(gradient_at(start)) / length)
    assert np.linalg.norm(matrix - expected) <= tolerance
    assert (matrix[held] == np.eye(len(held))[held]).all() and (matrix[:, held] == np.eye(len(held))[:, held]).all()
    n = len(held) // 2
    assert (matrix[:n, n:] == 0.0).all() and (matrix[n:, :n] == 0.0).all()
    assert np.linalg.norm(matrix[:n, :n] - matrix[n:, n:]) > 0.1 * np.linalg.norm(matrix)


def test_each_copy_has_its_policy(device):
    mesh = wc.Mesh.grid(4, 3, pattern="alternating")
    x = 0.8 * mesh.points + np.random.default_rng(9).normal(scale=0.05, size=mesh.points.shape)
    model = model_of(mesh, x, device=device, copies=3)

    def blocks(policy):
        hessian = Hessian(model)
        hessian.policy.assign(np.array(policy, dtype=np.float64))
        hessian.assemble(model.positions, 0.0)
        matrix = hessian.matrix().toarray()
        return [matrix[i : i + len(matrix) // 3, i : i + len(matrix) // 3] for i in range(0, len(matrix), len(matrix) // 3)]

    mixed = blocks([RAW, CLAMP, ABSOLUTE])
    for b, policy in enumerate(HessianPolicy):
        assert (mixed[b] == blocks([policy] * 3)[b]).all()
    assert np.linalg.eigvalsh(mixed[0])[0] < 0.0 and (mixed[0] != mixed[1]).any() and (mixed[1] != mixed[2]).any()


# --- what a bending stiffness means

BENDING = ("QuadraticBending", "DihedralBending")
# Curvature times edge length: small, so that the angle of a hinge is κ times a length up to (κ h)²/24.
BEND = 0.1


# Pattern, direction of curvature [degrees from the rows], U over ½Dκ² per area: least and most. The diagonals of "diagonal"
# run at 45°: a sheet that curves along them is the stiffest, one that folds about them is not. The least and most of
# "alternating" are at 0 and 45°.
CYLINDERS = [
    *(("equilateral", degrees, 1.0, 1.0) for degrees in (0, 10, 25, 30, 45, 60, 77, 90)),
    *(("diagonal", degrees, ratio, ratio) for degrees, ratio in ((0, 1.0), (90, 1.0), (45, 3.0), (135, 1.0), (105, 0.75))),
    *(("alternating", degrees, ratio, ratio) for degrees, ratio in ((0, 1.0), (90, 1.0), (45, 1.5))),
    *(("alternating", degrees, 1.0, 1.5) for degrees in (10, 20, 30, 60, 75)),
]


@pytest.mark.parametrize("name", BENDING)
@pytest.mark.parametrize(("pattern", "degrees", "least", "most"), CYLINDERS)
def test_a_cylinder_costs_its_curvature(name, pattern, degrees, least, most, device):
    ratio = bending_density(name, pattern, partial(rolled, radius=CELL / BEND, degrees=degrees), device) / (BEND / CELL) ** 2
    # Angles and chords of a circle differ from arcs by (κ h)²/24 in relation, h up to √3 edges, and enter squared.
    tolerance = 3.0 * 2.0 * BEND**2 / 24.0
    assert least * (1.0 - tolerance) <= ratio <= most * (1.0 + tolerance)


# --- what a solver needs


HARD, DAMPED, INFINITE = {"hard": True}, {"damping": 1.0}, "with infinite stiffness"
# A term, the sentence of the refusal, what the elements have and what the solver needs.
LACKING = [
    ("Spring", f"Spring {INFINITE}; B can, or give a finite stiffness", HARD, needs.FINITE),
    ("DihedralBending", f"DihedralBending {INFINITE}; B can", HARD, needs.FINITE, needs.PROJECTION),  # if finite, it cannot
    ("RigidCluster", "RigidCluster, whose bodies are no elements by themselves; B or C can", {}, needs.ELEMENTS),
    ("DihedralBending", "DihedralBending, whose energy is no squared distance to a set; B or C can", {}, needs.PROJECTION),
    (
        "StVKMembrane",
        f"StVKMembrane {INFINITE}, as its energy is no distance to a constraint; B can, or give a finite stiffness",
        *(HARD, needs.CLOSED_STEP),
    ),
    ("StVKMembrane", "StVKMembrane, whose energy is no square of a constraint; B or C can", {}, needs.ROWS),
    (
        "CorotatedMembrane",
        "the damping of CorotatedMembrane, which no projection has in it; B or C can, or leave the damping out",
        *(DAMPED, needs.MERGED_DAMPING),
    ),
    (
        "StrainLimit",
        f"StrainLimit {INFINITE}, as it has no scalar constraint; B can, or give a finite stiffness",
        *(HARD, needs.STEADY_ROWS),
    ),
    ("QuadraticBending", None, DAMPED | HARD, needs.MERGED_DAMPING, needs.STEADY_ROWS, needs.ROWS),
    ("DihedralBending", None, DAMPED, needs.MERGED_DAMPING, needs.LOCAL_STEP, needs.ROWS),
]


@pytest.mark.parametrize("row", LACKING, ids=lambda row: row[0])
def test_a_solver_refuses_a_term_that_lacks_what_it_needs(row):
    name, sentence, changes, *wanted = row
    elements = SimpleNamespace(**{"term": TERMS[name].term, "label": name, "hard": False, "damping": None} | changes)
    others = [("A", wanted), ("B", [needs.LOCAL_STEP]), ("C", [needs.LOCAL_STEP, needs.FINITE])]
    if sentence is None:
        needs.refuse_unmet([elements], "A", wanted, others)
        return
    with pytest.raises(ValueError) as refusal:
        needs.refuse_unmet([elements], "A", wanted, others)
    assert str(refusal.value) == f"A cannot take {sentence}"
