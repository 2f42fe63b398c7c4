"""Explicit integration, and the largest stable step of symplectic Euler."""

import warnings
from dataclasses import dataclass, replace
from functools import cached_property
from hashlib import sha256
from typing import Literal

import numpy as np

from ..base.turns import in_turn
from ..core.hessian import norms
from ..fast.plan import plan
from ..kernels.terms.air import AIR
from ..model.damping import dissipations
from ..model.host_values import host_values
from ..model.model import Model
from ..numerics.eigenvalues import largest, over_mass
from ..terms.needs import FINITE
from ..terms.refresh import STEP, Moment
from .facts import Benchmark, Facts
from .solver import LaunchedStepper, Stepper
from .step import Step, fewest_substeps

# The computed limit at rest of a copy is above this fraction of its limit in motion: its error is below 1 %.
_SURELY = 0.98


@dataclass(frozen=True)
class Explicit(Step):
    """Explicit Euler: symplectic, v += h a(x), then x += h v; or forward, x += h v and v += h a, both from the old x and v.

    On x″ = −ω²x the symplectic scheme conserves v² + ω²x² − hω²xv and is stable for h < 2/ω; forward Euler multiplies the
    energy by 1 + h²ω² in each step, so no h is stable (Provot 1995; Hairer, Lubich and Wanner 2006, *Geometric numerical
    integration*).

    Attributes:
        dt, substeps: See :class:`Step`.
        scheme: ``"symplectic"`` or ``"forward"``.
        above_limit: ``"refuse"`` or ``"allow"`` steps that are unstable about the rest shape.

    Examples:
        >>> import warpcloth as wc
        >>> scene = wc.Scene(wc.Mesh.chain(2), masses=[1, 1], terms=[wc.Spring(stiffness=1e3)], pins=[0])
        >>> about_rest, in_motion = wc.Explicit.step_limits(scene.build(dtype="float64"))
        >>> round(about_rest, 6)  # 2/ω, ω² = k/m
        0.063246
    """

    name = "explicit"
    needs = (FINITE,)
    limited = locks = touches_itself = True
    facts = Facts(
        method="symplectic or forward Euler; refuses steps above the stability limit",
        suits="cloth so soft that 100 to 1000 steps a frame suffice: no other method is then cheaper or more accurate",
        weakness=(
            "diverges if h is above 2/ω_max (measured to 0.03 %); stiff cloth needs too many steps: `cantilever` 5700 a frame"
        ),
        benchmarks=(Benchmark({}, cpu=(16, 32, 64, 128), cuda=(64, 128, 256, 512, 1024)),),
        runs=tuple({"fewest": factor} for factor in (1.0, 1.5, 2.0)),
        limits=("forward Euler", "2/ω_max", "2/√(2 Σk/m)"),
    )

    scheme: Literal["symplectic", "forward"] = "symplectic"
    above_limit: Literal["refuse", "allow"] = "refuse"

    @property
    def staggered(self) -> bool:
        return self.scheme == "symplectic"

    @classmethod
    def step_limits(cls, model: Model) -> tuple[float, float]:
        return step_limits(model)

    def stable(self, h: float, limit: float) -> bool:
        return self.scheme == "symplectic" and h < limit

    def without_limits(self) -> Step:
        return replace(self, above_limit="allow")

    def bind(self, model: Model) -> Stepper:
        """Binds the solver to ``model``.

        Without a step it takes the fewest substeps that respect both limits of :func:`step_limits`, the first by 10 %.

        Warns:
            UserWarning: The step is above the limit in motion.

        Raises:
            ValueError: The step is above the limit about the rest shape and that is not allowed, or a stiffness is infinite.
        """
        self.refuse(model)
        if not self.step_given:
            solver = replace(self, substeps=fewest_substeps(model.scene.fps, *step_limits(model)))
            return (solver if self.scheme == "forward" else solver.without_limits()).bind(model)
        stepper = self._on(ExplicitStepper, model)
        _refuse_strong_air(model, stepper.h)
        if self.above_limit == "refuse":
            self._refuse_unstable(model, stepper.h)
        return stepper

    def _refuse_unstable(self, model, h):
        limits = _Limits(model)
        if self.stable(h, limits.motion):
            return  # the limit about the rest shape is larger
        rest, motion = limits.rest, limits.motion
        fewest = int(1.0 / (model.scene.fps * rest)) + 1 if rest > 0.0 else 0
        allow = 'above_limit="allow" runs it all the same'
        if self.scheme == "forward":
            raise ValueError(
                f"dt is {h:.6g} s; forward Euler is stable at no step where nothing damps "
                f"(symplectic Euler up to {rest:.6g} s); {allow}"
            )
        if h >= rest:
            raise ValueError(
                f"dt is {h:.6g} s; about the rest shape symplectic Euler is stable below {rest:.6g} s, that is from "
                f"{fewest} substeps a frame; {allow}"
            )
        if h >= motion:
            warnings.warn(
                f"dt is {h:.6g} s; below {rest:.6g} s it is stable about the rest shape, but only below {motion:.6g} s "
                "in motion, hinges and membranes counted as at rest",
                stacklevel=4,
            )


def _refuse_strong_air(model, h):
    """Refuses steps in which the force of air at their start would more than stop a vertex in the wind: hΣ½ρAC|u|/3m > 1."""
    v = model.velocities.numpy().astype(np.float64)
    for elements in (each for each in model.terms if each.term is AIR):
        rest, stencil = host_values(elements.rest).astype(np.float64), host_values(elements.stencil)
        wind = rest[:, 8:11]
        air = model.scene.air
        speed = np.full(len(wind), air.speed) if air.keyframes is not None else np.linalg.norm(wind, axis=1)
        speed = speed + np.linalg.norm(v[stencil].mean(axis=1), axis=1)
        areas = np.tile(model.scene.mesh.triangle_areas, model.copies)
        drag = host_values(elements.stiffness) * 0.5 * areas * rest[:, 11:].max(axis=1) * speed / 3.0
        rate = np.zeros(model.count)
        np.add.at(rate, stencil, drag[:, None])
        most = float((rate * model.inverse_mass.numpy()).max(initial=0.0))
        if h * most > 1.0:
            fewest = int(most / model.scene.fps) + 1
            raise ValueError(
                f"dt is {h:.6g} s; in this wind the forces of air need steps of at most {1.0 / most:.6g} s, that is {fewest} "
                "substeps a frame; the implicit solvers that take air take any"
            )


@in_turn
def step_limits(model):
    """Returns the largest stable steps of symplectic Euler [s], about the rest shape and in motion.

    The first is the h at which the largest eigenvalue of M⁻¹(h²K + 2hC), found by Lanczos iteration, is 4, with K = ∂²U/∂x² and
    the damping matrix C at rest. The second uses Gershgorin's bound, the maximum over vertices of Σ‖∂²uₑ/∂xᵢ∂xⱼ‖/m, summed over
    elements and their vertices. It bounds any motion of springs and quadratic bending, but not of dihedral bending and
    membranes, whose Hessians at rest it takes. Both include contact, and strain and spring limits with their stiffness beyond
    the range, and are infinite if nothing is stiff.

    Raises:
        ValueError: A stiffness is infinite.
    """
    limits = _Limits(model)
    return limits.rest, limits.motion


@in_turn
def limit_in_motion(model):
    """Returns the second of :func:`step_limits`, the smaller and cheaper one.

    Raises:
        ValueError: A stiffness is infinite.
    """
    return _Limits(model).motion


class _Limits:
    def __init__(self, model):
        Explicit.refuse(model)
        self.model, self._unlike = model, [_Linearised(one) for one in _unlike(model)]

    @cached_property
    def rest(self):
        found = np.inf
        for one in sorted(self._unlike, key=lambda one: one.motion):
            if _SURELY * one.motion > found:
                break  # the limit at rest of a copy is above its limit in motion
            found = min(found, _at_rest(*one.matrices()))
        return _with_pairs(self.model, found)

    @cached_property
    def motion(self):
        return _with_pairs(self.model, min(one.motion for one in self._unlike))


def _with_pairs(model, h):
    """Returns the step limit with self-contact, from the limit h without: that of 4/h² + 4kA/m, by Gershgorin."""
    declared = model.scene.self_contact
    if declared is None:
        return h
    w = model.in_scene_order(model.inverse_mass.numpy()).reshape(model.copies, -1).max(axis=0)
    stiff = 4.0 * declared.stiffness * float((w * model.scene.mesh.vertex_areas).max())
    return float(1.0 / (0.5 / h + np.sqrt(0.25 / h**2 + 0.25 * stiff))) if stiff else h


def _unlike(model):
    """Returns a model of one copy for each distinct copy."""
    B = model.copies
    arrays = [model.inverse_mass, *(array for each in model.terms for array in (each.stiffness, each.rest, each.damping))]
    arrays += [each.cells.rest for each in model.terms if each.cells and each.cells.weights is not None]
    rows = [host_values(array).reshape(B, -1) for array in arrays if array is not None and 0 not in array.strides]
    if all((row == row[:1]).all() for row in rows):
        return [model.alone(0)]
    first = {}
    for copy in range(B):
        first.setdefault(sha256(b"".join(row[copy].tobytes() for row in rows)).digest(), copy)
    return [model.alone(copy) for copy in first.values()]


class _Linearised:
    def __init__(self, model):
        self._model, self._x, self._pushes = model, model.array(model.rest_points, model.vec3), _of_meshes(model)
        self._stiff = [elements.at_limit(model.rest_points) for elements in model.terms]
        self._damping = dissipations(model, 1.0)  # with stiffness β; at rest the Hessian is that of a linear damper
        if self._damping:
            model.refresh(STEP, Moment(self._x), self._damping)

    @cached_property
    def motion(self):
        w = self._model.inverse_mass.numpy()
        k, c = (norms(self._model, terms, self._x) * w if terms else 0.0 for terms in (self._stiff, self._damping))
        return float(np.min(_root(k + self._pushes * w, c), initial=np.inf))

    def matrices(self):
        """Returns M^-½ A M^-½ of the stiffness, and of the damping, (3n, 3n) [1/s²], [1/s]; None for what is absent."""
        K, C = (over_mass(self._model, terms, self._x) if terms else None for terms in (self._stiff, self._damping))
        if self._pushes.any():
            from scipy.sparse import diags, issparse
            from scipy.sparse.linalg import aslinearoperator

            pushes = diags(np.repeat(self._pushes, 3) * self._model.coordinate_mobility()).tocsr()
            K = pushes if K is None else K + (pushes if issparse(K) else aslinearoperator(pushes))
        return K, C


def _of_meshes(model):
    """Returns kA of each vertex of a copy (n,) [N/m], once for each mesh collider."""
    scene, count = model.scene, len(model.scene.meshes) if model.colliders is not None else 0
    areas = scene.mesh.vertex_areas if model.order is None else scene.mesh.vertex_areas[model.order]
    return count * scene.contact.stiffness * areas if count else np.zeros(len(areas))


def _at_rest(K, C):
    if C is None:
        return float(_root(0.0 if K is None else largest(K)[0], 0.0))
    h = _root(*(largest(matrix)[0] for matrix in (K, C)))
    for _ in range(20):  # the first h is too small; by Rayleigh's principle all others are too large and fall
        u = largest(h * h * K + 2.0 * h * C)[1]()
        before, h = h, _root(u @ K @ u, u @ C @ u)
        if abs(h - before) <= 1e-6 * h:
            break
    return float(h)


def _root(k, c):
    """Returns the h ≥ 0 with h² k + 2 h c = 4, infinite if both are 0."""
    with np.errstate(divide="ignore"):
        return np.divide(4.0, c + np.sqrt(c * c + 4.0 * np.maximum(k, 0.0)))


class ExplicitStepper(LaunchedStepper):
    """:class:`Explicit` on a model.

    Attributes:
        plan: The :class:`warpcloth.fast.plan.Plan`, whose ``record`` says how steps are taken.
    """

    def __init__(self, options, model, backend="auto"):
        super().__init__(options, model, None)
        symplectic = options.scheme == "symplectic"
        self.plan = plan(self.model, backend)
        given = tuple(self.state), self.h, symplectic, self.count, self.colliders, self.pairs
        self._steps = self.plan.explicit_step(*given)
        self.state.add("position residual", self._steps.residual)
        self.record((lambda: self.launch_steps(1), 1))

    def _record_frame(self):
        if not self.model.dynamic:
            return super()._record_frame()
        return [(self._segment_of(self.steps_per_frame), 1)]  # a loop on the device

    def follow_contact(self):
        self.colliders.note_pushes()
        if self.plan.guard is not None:
            self.plan.guard.follow()
        self._record_step()

    def launch_steps(self, steps):
        self._steps.launch(steps, self.launch_end_of if self.plan.guard is None else self.launch_pins_of)
