"""Static equilibria: minima of the energy of a scene and its weight, without inertia."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

import warpcloth.contact as contact

from ..base.checks import array, choice, number, whole
from ..base.limits import MAX_FRAMES
from ..base.turns import in_turn
from ..base.types import Precision
from ..core.state import State
from ..core.status import Grade, Residual, Result, Status, digits, sentence
from ..kernels.terms.air import AIR
from ..numerics.iterate import ResidualScale
from ..numerics.minimise import Minimiser
from ..numerics.multigrid import MIN_VERTICES
from ..scene.scene import Scene
from ..terms.needs import FINITE, refuse_unmet
from ..terms.refresh import STEP, Moment
from .history import Evaluation, checked_record, collider_names, last_frame
from .softened import softened, softening

SETTLED = (Result.CONVERGED, Result.ROUNDED)
RESIDUAL = Residual("sum of the unbalanced forces")
WEIGHT = "times the weight"
# Iterations after which stiff cloth starts from the rest shape of softer cloth, and the residual below which it does not; the
# tolerance of softer cloth, its most iterations for one stiffness, and for all of them as a share of those that are left.
PATIENCE, NEARLY, ROUGHLY, MAX_SOFT, SOFT_SHARE = 10, 0.1, 1e-3, 200, 0.5
# A descent that ended by rounding, and moved by less than this fraction of the size of the cloth, is not repeated.
NEAR = 1e-5


class Equilibrium(NamedTuple):
    """A static equilibrium.

    Attributes:
        points: (n, 3) [m].
        status: How it ended, with the residual Σ‖fᵢ‖/Σmᵢ‖g‖ of the unbalanced forces; without gravity the divisor is the sum of
            the loads, and without loads the value at the start. ``distance`` is the length of the last Newton step. ``ok`` is
            false if forces do not balance to the tolerance or to rounding, or the shape is not stable.
        iterations: Total number of Newton iterations; a round of proximal steps counts as one more.
        lowest_eigenvalue: Lowest eigenvalue of the Hessian of the energy over the free vertices [N/m]; NaN if forces do not
            balance.
        stable: Whether forces balance and no eigenvalue is negative beyond rounding and the tolerance. A move without energy,
            as of a free body, has the eigenvalue 0 and counts as stable.
        energies: With ``record="energies"``, a dictionary [J]: each term, ``"self-contact"``, ``"gravity"`` since the start,
            and ``"work of loads"`` (constant loads).
        reactions: With ``record="reactions"``, forces of the pins on the cloth along held axes, (p, 3) [N].
        collider_forces: With ``record="reactions"``, forces of the cloth on the colliders by name, (3,) [N].
    """

    points: np.ndarray
    status: Status
    iterations: int
    lowest_eigenvalue: float = np.nan
    stable: bool = False
    energies: dict[str, float] | None = None
    reactions: np.ndarray | None = None
    collider_forces: dict[str, np.ndarray] | None = None


@in_turn
def equilibrium(
    scene: Scene,
    tolerance: float = 1e-8,
    load_steps: int = 1,
    iterations: int = 1000,
    device: str = "cpu",
    dtype: Precision = "float64",
    linear: Literal["auto", "factorised", "cg"] = "auto",
    record: str | Sequence[str] = (),
    vary: Mapping[str, ArrayLike] | None = None,
    start: ArrayLike | None = None,
) -> Equilibrium:
    """Finds the shape that minimises U(x) − Σ m g·x, from the positions of the scene, with the pins in their final positions.

    Pins, loads, wind and colliders have the values of their last keyframes; a wind function has that of the end. Pressure and
    wind follow the cloth: their forces are held constant while it settles, and computed again until all forces balance.
    ``stable`` and ``lowest_eigenvalue`` are for constant forces; a shape at rest in wind may flutter in a run.

    With friction the rest shape depends on the motion, so it is refused: run such a scene with damping. With self-contact or
    mesh colliders no iterate crosses cloth or mesh. If cloth stops pins on their way, the iterations are used up. The pairs are
    held constant while the cloth settles; ``stable`` neglects their rotation. Layers without friction may slide off one another
    and then have no equilibrium.

    The method is Newton's with a line search; gravity grows in load steps. Nearly inextensible cloth that does not settle in 10
    iterations starts from the equilibrium of softer cloth if the scene has only gravity and energies and starts at its rest
    shape; ``start=scene.positions`` prevents this. For a singular Hessian, a proximal term s/2‖x − x_now‖²_M is added and s
    lowered. A final shape with a negative eigenvalue is perturbed and settles again. Cloth that nothing holds is reported as
    not converged.

    Args:
        scene: Its velocities and duration have no effect.
        tolerance: Tolerance of the residual of :class:`Equilibrium`, and of the unbalanced acceleration of each vertex over
            gravity (without gravity over loads per mass, without loads over the largest at the start). If rounding exceeds it
            at a vertex, the descent ends when the energy no longer falls, and the residual decides. With gravity, an unbalanced
            half of the weight is no equilibrium.
        load_steps: Number of steps in which gravity and loads grow and pins move along their keyframes. Pins that rotate far
            need several.
        iterations: Maximum number of Newton iterations in total.
        device: A Warp device.
        dtype: ``"float32"`` or ``"float64"``.
        linear: ``"factorised"``; ``"cg"``, conjugate gradients with multigrid; or ``"auto"``, the first below 200 vertices and
            else the second.
        record: ``"energies"``, ``"reactions"`` or both.
        vary: Values of one copy in place of those of the scene, as of :class:`warpcloth.model.model.Model`.
        start: Positions to descend from, (n, 3) [m]; gravity is still measured from the positions of the scene. Pins without
            keyframes and locked coordinates keep the positions of the scene. Cloth must not cross itself there, and free
            vertices must be outside colliders.

    Raises:
        ValueError: An argument is not allowed, a stiffness is infinite, there is friction, a free vertex starts inside a
            collider, or cloth crosses cloth at the start.

    Examples:
        >>> import warpcloth as wc
        >>> scene = wc.Scene(wc.Mesh.chain(2), masses=[1, 1], terms=[wc.Spring(stiffness=1e3)], pins=[0])
        >>> rest = wc.equilibrium(scene)
        >>> round(float(-1 - rest.points[1, 1]), 6)  # the weight over the stiffness
        0.00981
        >>> rest.stable
        True
    """
    number("tolerance", tolerance, above=0.0)
    whole("load_steps", load_steps, 1)
    whole("iterations", iterations, 1)
    choice("linear", linear, ("auto", "factorised", "cg"))
    record = checked_record(record)
    scene = _with_colliders_at_rest(scene)
    model = scene.build(device=device, dtype=dtype, vary=vary)
    refuse_unmet(model.terms, "equilibrium", (FINITE,), ())
    base = wp.clone(model.positions)
    if start is not None:
        base.assign(_with_held(scene, model, array("start", start, (model.count, 3))))
    pairs = None
    if model.has_pairs:
        state, colliders = State(base, model.vectors(), 1), None
        if model.colliders is not None and model.colliders.meshes is not None:  # whose poses the pairs need
            colliders = contact.ColliderSteps(model, state, 0.0, 1, 1.0)
            colliders.launch_move()
        pairs = contact.SelfSteps(model, state, h=0.0, steps_per_frame=1, bounded=False, colliders=colliders)
        pairs.filter.iterates()
    if linear == "auto":
        linear = "cg" if model.per_copy >= MIN_VERTICES else "factorised"
    touching = model if pairs is None else model.with_dynamic(pairs.forces.terms)
    minimiser = Minimiser(touching, base, "adaptive", linear, s=0.0, pairs=pairs)
    wind = _Wind(model, base) if scene.air_terms else None
    descent = _Descent(minimiser, base, tolerance, iterations, wind)
    if start is None and load_steps == 1 and _only_hangs(scene) and _is_at_rest(model, base):
        _start_softly(model, base, descent, linear)
    for part in range(1, load_steps + 1):
        result = _settle_all(model, base, descent, part / load_steps)
    # Forces balance, but they do for a straight chain that stands on its pin too. A small perturbation tells them apart.
    if wind is not None:
        wind.hold()
    if result in SETTLED and minimiser.curves_down(tolerance):
        base.assign(base.numpy() + _nudge(model))
        # A small unbalanced force compresses the edges of a nearly straight chain by much more, and changes the eigenvalues.
        descent.tolerance *= 0.01
        if pairs is None and wind is None:
            result = descent.run(1.0, _frequency_scale(model))
        else:
            result = _settle_all(model, base, descent, 1.0)
        if wind is not None:
            wind.hold()
        if result in SETTLED and minimiser.curves_down(tolerance):
            result = Result.SADDLE
    residual, began = descent.residual, result.value
    if result is Result.ROUNDED and residual <= tolerance:
        result = Result.CONVERGED
    # A sheet that did not move has its whole weight unbalanced. Without gravity, a start at rest has only rounding unbalanced.
    elif result is Result.ROUNDED and residual > 0.5 and descent.unit == WEIGHT:
        result, began = Result.STALLED, f"rounding hides the equilibrium in {dtype}"
    lowest = minimiser.lowest_eigenvalue() if result in (*SETTLED, Result.SADDLE) else np.nan
    grade = {Result.CONVERGED: Grade.CONVERGED, Result.ROUNDED: Grade.COMPLETED}.get(result, Grade.NOT_USABLE)
    why = "it is not an equilibrium"
    if result is Result.SADDLE:
        why = f"it is not stable, because the lowest eigenvalue of the Hessian is {digits(lowest)} N/m"
    distance = descent.left
    given = residual, RESIDUAL.measure, descent.unit, tolerance
    message = sentence(result, grade, distance, *given, why=why, of="the equations of balance")
    if result is Result.STALLED:
        message = message.replace(result.value, began)
    status = Status(result, 0, residual, message, None, RESIDUAL.measure, descent.unit, grade, distance, (grade,))
    energies = reactions = forces = None
    if record:
        evaluation = Evaluation(model, forces="reactions" in record, pairs=pairs)
        if "energies" in record:
            energies = {name: float(value[0]) for name, value in evaluation.energies(base).items()}
        if "reactions" in record:
            evaluation.launch(base)
            reactions = evaluation.reactions()[0]
            if evaluation.pulls:
                forces = dict(zip(collider_names(scene), evaluation.pulls.sums(1)[0, :, 0], strict=True))
    recorded = energies, reactions, forces
    return Equilibrium(np.array(base.numpy()), status, descent.used, lowest, result in SETTLED, *recorded)


def _only_hangs(scene):
    others = scene.colliders, scene.loads, scene.air_terms
    return not any(others) and scene.self_contact is None and scene.pins.keyframes is None


def _is_at_rest(model, base):
    points = model.rest_points
    return bool(np.abs(base.numpy() - points).max() <= 1e-6 * np.ptp(points, axis=0).max())


def _start_softly(model, base, descent, linear):
    """Sets the positions to the rest shape of softer cloth, unless few iterations suffice without or softer cloth does not
    rest.

    Cloth that is nearly at rest is left to settle: it may stand in a shape, such as an arch, that softer cloth does not hold.
    """
    factors = softening(model)
    if not factors or descent.settle(0.0, 1.0, PATIENCE) in SETTLED or descent.residual < NEARLY:
        return
    before, left = wp.clone(base), int(SOFT_SHARE * (descent.iterations - descent.used))
    for factor in factors:
        minimiser = Minimiser(softened(model, factor), base, "adaptive", linear, s=0.0)
        stage = _Descent(minimiser, base, ROUGHLY, min(MAX_SOFT, left), None)
        result = stage.run(1.0, _frequency_scale(model))
        descent.used, left = descent.used + stage.used, left - stage.used
        if result not in SETTLED:
            wp.copy(base, before)
            return


def _with_colliders_at_rest(scene):
    for collider in scene.colliders:
        if collider.friction:
            raise ValueError(
                f"the collider {collider.label} has friction {collider.friction:g}, with which there are many rest shapes and "
                "the motion decides among them; set it to 0, or run the scene with damping until it rests"
            )
    if scene.self_contact is not None and scene.self_contact.friction:
        raise ValueError(
            f"self_contact.friction is {scene.self_contact.friction:g}, with which there are many rest shapes and the motion "
            "decides among them; set it to 0, or run the scene with damping until it rests"
        )
    if not any(collider.moves for collider in scene.colliders):
        return scene
    try:
        return replace(scene, colliders=[collider.at_last() for collider in scene.colliders])
    except ValueError as error:
        raise ValueError(f"where the last keyframe has the colliders, {error}; move the cloth, or run the scene") from None


class _Descent:
    def __init__(self, minimiser, base, tolerance, iterations, wind):
        self.minimiser, self.base, self.tolerance, self.iterations = minimiser, base, tolerance, iterations
        self.wind = wind
        self.used, self.moved, self.pairs = 0, 0.0, minimiser.pairs
        self.left = 0.0  # length of the last Newton step, which is at least as long as what is left [m]
        self._apart = wp.clone(base)  # the last positions without crossings
        model = minimiser.model
        gravity, self.unit = np.linalg.norm(model.gravity.numpy().astype(np.float64), axis=1), WEIGHT
        self.scale = gravity
        if gravity[0] == 0.0:
            self.scale, self.unit = ResidualScale(model).driven, "times the loads"
        self.load = float(self.scale[0] * model.mass.numpy()[model.inverse_mass.numpy() > 0.0].sum(dtype=np.float64))
        self.size = np.linalg.norm(np.ptp(base.numpy(), axis=0))

    def run(self, load, s):
        """Settles, with proximal steps if it gets stuck; returns the last result."""
        while True:
            result = self.settle(0.0, load, self.iterations)
            least, found = (np.inf, np.inf), (self.moved, self.unbalanced)
            # A long d has a large rounding, so start again from here; it is short then, unless moves cost no energy.
            while result is Result.ROUNDED and self.moved > NEAR and self.used < self.iterations and _halved(found, least):
                least = tuple(map(min, found, least))
                result = self.settle(0.0, load, self.iterations)
                found = self.moved, self.unbalanced
            if result in SETTLED or result is Result.DIVERGED or self.used >= self.iterations:
                return result
            for _ in range(8):
                self.settle(s, load, 20)
            s /= 16.0
            self.used += 1  # so that rounds without a direction end too

    def balanced(self, update):
        """Returns whether forces balance to the tolerance or to rounding, with updated areas and loads."""
        self.minimiser.clear()
        rounded = float(self.minimiser.unbalanced()[0])
        update()
        self._begin()
        self.minimiser.clear()
        self.found = found = float(self.minimiser.unbalanced()[0])
        if found > max(self.tolerance * self.load, 2.0 * rounded):
            return False
        self.unbalanced = max(self.unbalanced, min(found, self.tolerance * self.load))
        return True

    @property
    def residual(self):
        return self.unbalanced / self.load

    def settle(self, s, load, most):
        """Minimises once, in at most ``most`` iterations; returns the result."""
        self.minimiser.set_objective(s, load)
        self._begin()
        if self.load == 0.0:
            self.minimiser.clear()
            self.load, self.unit = float(self.minimiser.unbalanced()[0]) or 1.0, "times that at the start"
            self.scale = self.minimiser.search.acceleration.numpy().copy()
            self.scale[self.scale == 0.0] = 1.0
        most = min(most, max(self.iterations - self.used, 0))
        (result,) = self.minimiser.minimise(self.tolerance, most, self.scale)
        while self.pairs is not None and self.pairs.overflowed:
            self._grow()
            self._begin()
            (result,) = self.minimiser.minimise(self.tolerance, most, self.scale)
        self.unbalanced = float(self.minimiser.unbalanced()[0])
        self.used += self.minimiser.iterations
        direction, correction = (array.numpy() for array in (self.minimiser.search.direction, self.minimiser.correction))
        if self.minimiser.iterations:
            self.left = float(np.linalg.norm(direction.astype(np.float64), axis=1).max())
        self.moved = np.abs(correction).max(initial=0.0) / self.size
        self.base.assign(self.base.numpy() + correction)
        wp.copy(self._apart, self.base)
        return result

    def _begin(self):
        if self.pairs is None:
            return
        self.pairs.launch_begin(self._apart)
        while self.pairs.overflowed:
            self._grow()
            self.pairs.launch_begin(self._apart)

    def _grow(self):
        self.pairs.grow()
        self.minimiser.record()


class _Wind:
    """The forces of wind on cloth at rest, which follow its normals and have no energy.

    Cloth without mass moves by implicit steps of the law of air from velocity 0; at rest the force does not depend on the step.
    A step is half as long as the last if that raised the unbalanced force, else a tenth longer.
    """

    def __init__(self, model, base):
        self._model, self._base, self._still = model, base, model.vectors()
        self._elements = [each for each in model.terms if each.term is AIR]
        winds = [np.linalg.norm(each.rest.numpy()[:, 8:11], axis=1).max() for each in self._elements]
        speed = max(model.scene.air.speed, *winds)
        self._seconds = 0.1 * float(np.linalg.norm(np.ptp(base.numpy(), axis=0))) / (speed or 1.0)
        self._residual = np.inf

    def set(self):
        self._set(self._seconds)

    def hold(self):
        self._set(1e9 * self._seconds)

    def adapt(self, residual):
        """Chooses the next step from the unbalanced force."""
        self._seconds *= 0.5 if residual > self._residual else 1.1
        self._residual = residual

    def _set(self, seconds):
        moment = Moment(self._base, v=self._still, he=seconds, ahead=last_frame(self._model.scene))
        self._model.refresh(STEP, moment, self._elements)


def _settle_all(model, base, descent, part):
    """Settles under the fraction ``part`` of loads and keyframes until the loads that follow the cloth are constant."""
    pins, loads, wind = model.scene.pins, model.loads, descent.wind
    follows = descent.pairs is not None or wind is not None or (loads is not None and loads.follows)

    def set_loads():
        if wind is not None:
            wind.set()
        if loads is not None:
            # The last keyframe.
            loads.set(model, Moment(base, ahead=MAX_FRAMES))

    while True:
        base.assign(_with_pins(pins, base.numpy(), part))
        set_loads()
        result = descent.run(part, _frequency_scale(model))
        if not follows or result not in SETTLED:
            return result
        points = base.numpy()
        arrived = (points == _with_pins(pins, points, part)).all()
        if descent.used >= descent.iterations:
            return result if arrived else Result.ITERATIONS_USED_UP
        if arrived and descent.balanced(set_loads):
            return result
        if wind is not None:
            wind.adapt(descent.found)
        descent.used += 1


def _with_held(scene, model, start):
    """Returns a start (n, 3) [m] with the coordinates that nothing moves where the model has them; refuses vertices in
    colliders.
    """
    held = model.coordinate_mobility().reshape(-1, 3) == 0.0
    if scene.pins.keyframes is not None:  # these are set in each load step
        held[scene.pins.vertices] &= ~scene.pins.held
    points = np.where(held, model.positions.numpy(), start)
    scene.refuse_inside(points, " in start")
    return points


def _halved(found, least):
    return any(one <= 0.5 * before for one, before in zip(found, least, strict=True))


def _with_pins(pins, points, part):
    if pins.keyframes is None:
        return points
    at = part * (len(pins.keyframes) - 1)
    before = min(int(at), len(pins.keyframes) - 1)
    one, two = pins.keyframes[before], pins.keyframes[min(before + 1, len(pins.keyframes) - 1)]
    moved = np.array(points)
    moved[pins.vertices] = np.where(pins.held, one + (at - before) * (two - one), points[pins.vertices])
    return moved


def _nudge(model):
    """Returns displacements of free vertices of about 1e-4 of the cloth's size, (n, 3) [m], always equal."""
    size = np.linalg.norm(np.ptp(model.positions.numpy(), axis=0))
    noise = np.random.default_rng(0).normal(size=(model.count, 3))
    return 1e-4 * size * noise * (model.coordinate_mobility() > 0.0).reshape(-1, 3)


def _frequency_scale(model):
    """Returns (10ω)² = 100 g over the size of the cloth [1/s²]; 1 without gravity."""
    size = np.linalg.norm(np.ptp(model.positions.numpy(), axis=0))
    gravity = float(np.linalg.norm(model.gravity.numpy()))
    return 100.0 * gravity / size if gravity > 0.0 else 1.0
