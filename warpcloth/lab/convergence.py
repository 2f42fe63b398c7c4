"""Measures how fast methods minimise one step of implicit Euler: the gap of the objective over iterations and time."""

import json
import math
import statistics
import time
from functools import cache

import numpy as np
import warp as wp

from ..base.digest import scene_digest
from ..base.turns import TURN, in_turn
from ..core.energy import Energy
from ..core.sums import Sums
from ..run.equilibrium import SETTLED
from ..run.simulate import simulate
from ..solvers import Newton
from .measurements import SceneRef, Setup

# Numbers of iterations to try, about a factor √2 apart.
LADDER = sorted({k * 2**i for k in (2, 3) for i in range(17)} | {1})
# A method ends if six rungs, or eight times the iterations, do not help. But the gap may rise before it falls, so that it gets
# at least ENOUGH iterations.
IDLE, ENOUGH = 6, 512
LOST = 1e6  # gap beyond which a method has diverged
SEED = 0  # of the random roundings that give the accuracy of the minimum


class OneStep:
    """A step of implicit Euler from a state of a scene in motion, and φ(d) = 1/(2h²)‖d‖²_M + U(x̃ + d), d = x − x̃, in float64.

    Newton computes the state and the minimiser. The state is rounded to float32, so that all precisions start at the same
    positions. It comes ``frame`` frames after the start, with ``substeps`` steps each.

    Attributes:
        h: Step [s].
        base: x̃ (n,) vectors on the device [m].
        best: The minimiser d (n, 3) [m].
        lowest, first: φ at the minimiser and at d = 0 [J].
        floor: Rounding of the gap (φ − lowest)/(first − lowest).

    Raises:
        ValueError: Newton does not take the scene, or does not reach the state or the minimiser.
    """

    def __init__(self, scene, frame, substeps, device="cpu"):
        self.scene, self.substeps = scene, substeps
        model = scene.build(device=device, dtype="float64")
        x, v = (array.numpy() for array in (model.positions, model.velocities))
        if frame:
            earlier = simulate(scene, Newton(substeps=substeps), device=device, dtype="float64", frames=frame)
            if not earlier.status.complete:
                raise ValueError(f"{scene.name} has no frame {frame} to step from: {earlier.status.message}")
            x, v = earlier.points[-1], earlier.velocities[-1]
        self._start = [np.float32(array).astype(np.float64) for array in (x, v)]
        self._count = frame * substeps
        stepper = Newton(substeps=substeps, tolerance=1e-14, iterations=500, linear="factorised").bind(model)
        self.set_state(stepper)
        stepper.step()
        if stepper.results[0] not in SETTLED:
            raise ValueError(f"the step after frame {frame} of {scene.name} ends by Newton with {stepper.results[0].value}")
        self.h, self.model = stepper.h, stepper.model
        self.free = model.inverse_mass.numpy() > 0.0
        self._mass = model.mass.numpy() * self.free
        self.best = np.array(stepper.minimiser.correction.numpy())
        with TURN:
            self.base = model.array(stepper.state.x.numpy() - self.best, model.vec3)
            self._energy_of = Energy(self.model, Sums(self.model), corrected=True)
        self.lowest, self.first = self.objective(self.best), self.objective(np.zeros_like(self.best))
        # The rounding of the state alone strains the cloth.
        if not np.abs(self.best).max() > 10.0 * np.finfo(np.float32).eps * np.abs(x).max():
            raise ValueError(f"the step after frame {frame} of {scene.name} has nothing to minimise; take another frame")
        self.floor = self._rounding() / (self.first - self.lowest)

    @in_turn
    def set_state(self, stepper):
        """Sets a bound solver to the state, as if it had not stepped before."""
        model = stepper.model
        stepper.reset()
        for array, values in zip(stepper.state, self._start, strict=True):
            array.assign(model.array(values, model.vec3))
        if stepper.count is not None:
            stepper.count.fill_(self._count)
        if stepper.colliders is not None:
            stepper.colliders.steps.fill_(self._count)

    def correction(self, stepper):
        """Returns d (n, 3) [m] of a step from the state: x − x̃ = h(v − v₀ − hg), g with loads, to keep digits in float32."""
        change = stepper.state.v.numpy() - self._start[1] - self.h * self.model.free_gravity[0].numpy()
        return np.where(self.free[:, None], self.h * change, 0.0)

    @in_turn
    def objective(self, d):
        model = self.model
        energy = wp.zeros(1, dtype=wp.float64, device=model.device)
        self._energy_of.add(self.base, energy, model.array(d, model.vec3))
        return float(0.5 * (self._mass[:, None] * d**2).sum() / self.h**2 + energy.numpy()[0])

    def gap(self, d):
        """Returns (φ(d) − lowest)/(first − lowest): 1 at x̃, 0 at the minimiser."""
        return (self.objective(d) - self.lowest) / (self.first - self.lowest)

    def roundings(self):
        """Returns eight random changes of d by a rounding of every coordinate of x, (8, n, 3) [m]."""
        random = np.random.default_rng(SEED)
        epsilon = np.finfo(np.float64).eps * np.abs(self.base.numpy()).max()
        return epsilon * random.uniform(-1.0, 1.0, size=(8, *self.best.shape)) * self.free[:, None]

    def _rounding(self):
        return max(abs(self.objective(self.best + move) - self.lowest) for move in self.roundings())


def one_step(scene, digest, frame, substeps, device):
    """Returns the :class:`OneStep` of a scene; all tasks of a process share it.

    Raises:
        ValueError: The scene has another digest.
    """
    return _one_step(json.dumps(scene, sort_keys=True), digest, frame, substeps, device)


@cache
def _one_step(scene, digest, frame, substeps, device):
    declared = SceneRef(**json.loads(scene)).load()
    if scene_digest(declared) != digest:
        raise ValueError(f"{declared.name} is another scene now than when its measurements were listed; start again")
    return OneStep(declared, frame, substeps, device)


def measure(scene, digest, setup, frame, substeps, device="cpu", dtype="float64", limit=20.0, repeats=5):
    """Measures the gap of one step from x̃ after increasing numbers of iterations.

    Arguments and results are JSON values. ``digest`` gives another scene another key, ``setup`` has neither step nor
    iterations, the step comes after ``frame`` frames, and the median of ``repeats`` warm steps counts. Gaps are computed in
    float64. ``limit`` [s] bounds the time without the state and the minimum.

    Returns:
        dict: ``status``, ``reason``, ``points`` with ``iterations``, ``gap``, ``ms`` and ``spread`` (quartiles) of the step,
        ``floor``, ``message`` (why there are no more points), ``compile_s``, ``factorise_s``.

    Raises:
        ValueError: The scene has no such step.
    """
    step = one_step(scene, digest, frame, substeps, device)
    result = {"status": "ok", "reason": "", "message": "", "points": [], "floor": step.floor}
    result |= {"compile_s": None, "factorise_s": None}
    began = None
    for iterations in LADDER:
        options = {**setup["options"], "substeps": substeps, "iterations": iterations}
        record, before = Setup(setup["solver"], options).record(), time.perf_counter()
        try:
            stepper = record.bind(step.scene.build(device=device, dtype=dtype))
        except ValueError as error:
            return result | {"status": "refused", "reason": str(error)}
        if began is None:
            began, factorise = time.perf_counter(), stepper.factorise_seconds
            result |= {"compile_s": began - before - factorise, "factorise_s": factorise}
        step.set_state(stepper)
        stepper.step()
        gap = step.gap(step.correction(stepper))
        if not gap < LOST:
            return result | {"status": "diverged", "reason": f"a gap of {gap:.2g} after {iterations} iterations"}
        low, ms, high = _milliseconds(step, stepper, repeats)
        result["points"].append({"iterations": iterations, "gap": gap, "ms": ms, "spread": [low, high]})
        if gap <= step.floor:
            return result | {"message": "as near as float64 tells"}
        if _ended(result["points"]):
            return result | {"message": f"no nearer after {iterations} iterations"}
        taken = time.perf_counter() - began
        if iterations == 1 and taken > limit:
            return result | {"status": "slow", "reason": f"one iteration took {taken:.3g} s, more than {limit:g} s"}
        if taken + 1.5e-3 * (repeats + 1) * ms > limit:
            return result | {"message": f"{iterations} iterations in the time"}
    return result | {"message": f"{iterations} iterations"}


def _ended(points):
    gaps = [point["gap"] for point in points]
    if gaps[-2:] == 2 * gaps[-1:]:
        return True
    return points[-1]["iterations"] >= ENOUGH and min(gaps[-IDLE:]) > 0.99 * min(gaps[:-IDLE], default=math.inf)


def _milliseconds(step, stepper, repeats):
    taken = []
    for _ in range(repeats):
        step.set_state(stepper)
        wp.synchronize_device(stepper.model.device)
        began = time.perf_counter()
        stepper.step()
        wp.synchronize_device(stepper.model.device)
        taken.append(1e3 * (time.perf_counter() - began))
    return statistics.quantiles(taken, n=4, method="inclusive") if repeats > 1 else 3 * taken
