"""The base classes of the records of solvers, and their catalogue by name."""

import math
from dataclasses import dataclass, fields
from typing import ClassVar, Literal

from ..base.checks import choice, keep_plain, ranged, shown
from ..base.extensions import note
from ..base.limits import MAX_COUNT
from ..base.quiet import find_device
from ..base.texts import words_of
from ..base.turns import methods_in_turn
from ..base.types import Precision
from ..core.status import Residual
from ..model.model import Model
from ..model.precision import DTYPES
from ..numerics.integrators import INTEGRATORS
from ..scene.scene import Scene
from ..terms.needs import FINITE, NORMAL_FORCE, Need, listed, refuse_unmet
from . import SOLVERS
from .error_steps import SHORTEST, ErrorStepper
from .facts import Facts
from .solver import Stepper
from .threaded import ThreadedStepper

# Steps per second by default; substeps are chosen nearest to it.
_STEPS_A_SECOND = 240


def register(record):
    """Adds the record of a solver to :data:`SOLVERS`, where commands find it by its ``name``; also a decorator.

    Args:
        record: A frozen dataclass that derives from :class:`Step` and has a ``name``.

    Raises:
        ValueError: It is not such a class, or another one of that name is registered.
    """
    if not (isinstance(record, type) and issubclass(record, Step) and isinstance(record.name, str)):
        raise ValueError(
            f"{record!r} is no solver; it must be a class with a name that derives from warpcloth.solvers.step.Step"
        )
    known = SOLVERS.get(record.name, record)
    if known.__module__ != record.__module__:
        raise ValueError(f"{record.name!r} is the name of a solver of {known.__module__}; {record.__name__} must have another")
    SOLVERS[record.name] = record
    note(record)
    return record


@dataclass(frozen=True)
class Step:
    """The step of a solver: one of ``dt`` and ``substeps``, or about 1/240 s if neither is given.

    A ``limited`` solver without a step takes the longest that is safe on its model, see :func:`fewest_substeps`.

    Attributes:
        dt: Step [s]; 1/(fps·dt) must be a whole number.
        substeps: Number of steps per frame.
        ordered: Whether the result depends on the order of elements by more than rounding.
        staggered: Whether velocities are half a step behind positions in time.
        closes: Whether a step may close the gap of a constraint regardless of its stiffness.
        residual: The :class:`warpcloth.core.status.Residual` that its steps report, or None.
        name: Its name on the command line and in charts.
        needs: Needs of every term, of :mod:`warpcloth.terms.needs`. Errors name the first that is not met.
        facts: Its :class:`warpcloth.solvers.facts.Facts`.
        touches_itself: Whether it supports self-contact.
        locks: Whether it supports locked coordinates, by ``free_axes`` or the axes of pins.
        limited: Whether it refuses steps above a stability limit.
        step_options: Names of the options that set the step, of which at most one may be given.
        double_on_cpu: Whether runs on the CPU are in float64 by default.

    Raises:
        ValueError: An option is not allowed, or two that set the step are given.
    """

    ordered: ClassVar[bool] = False
    staggered: ClassVar[bool] = False
    closes: ClassVar[bool] = False
    locks: ClassVar[bool] = False
    touches_itself: ClassVar[bool] = False
    residual: ClassVar[Residual | None] = None
    name: ClassVar[str | None] = None
    needs: ClassVar[tuple[Need, ...]] = ()
    facts: ClassVar[Facts] = Facts()
    limited: ClassVar[bool] = False
    step_options: ClassVar[tuple[str, ...]] = ("dt", "substeps")
    double_on_cpu: ClassVar[bool] = False

    def __init_subclass__(cls, **options):
        super().__init_subclass__(**options)
        methods_in_turn(cls, "bind")

    dt: float | None = ranged(None, above=0.0)
    substeps: int | None = ranged(None, whole=True, least=1)

    @classmethod
    def precision_on(cls, device: str, dtype: Precision | None = None) -> Precision:
        """Returns the precision of runs, by default float64 on the CPU if the solver is ``double_on_cpu``, else float32.

        Args:
            device: A Warp device.
            dtype: ``"float32"``, ``"float64"`` or None.

        Raises:
            ValueError: There is no such precision or device.
        """
        if dtype is None:
            return "float64" if cls.double_on_cpu and not find_device(device).is_cuda else "float32"
        choice("dtype", dtype, tuple(DTYPES))
        return dtype

    def residual_on(self, model: Model) -> Residual | None:
        """Returns the residual that its steps report on a model."""
        return self.residual

    @property
    def damps(self) -> bool:
        """Whether its steps damp frequencies that they do not resolve, or are refused above a stability limit."""
        return True

    def bind(self, model: Model) -> Stepper:
        """Binds the solver to ``model`` and allocates all arrays.

        Raises:
            ValueError: A term lacks a property that the solver needs.
        """
        raise NotImplementedError  # every solver has its own

    @classmethod
    def refuse(cls, model, needs=None, options="", instead=None):
        """Checks that the solver can take a model.

        Args:
            model: The model.
            needs: Further needs that come with an option, or None.
            options: That option, as text.
            instead: A value of the option without these needs, as text.

        Raises:
            ValueError: It cannot. The message names the term or field of the scene, and what would work.
        """
        if not isinstance(model, Model):
            given = "a Scene" if isinstance(model, Scene) else shown(model)
            raise ValueError(f"model is {given}; bind takes a model, which scene.build() makes")
        if model.mobility is not None and not cls.locks:
            able = [record.__name__ for record in SOLVERS.values() if record.locks]
            raise ValueError(
                f"{cls.__name__} cannot take a vertex that is locked along some axes, by free_axes or its pin; "
                f"{listed(able)} can"
            )
        if model.has_pairs:
            cls._refuse_pairs(model)
        if needs is None:
            others = ((record.__name__, record.needs) for record in SOLVERS.values())
            refuse_unmet(model.terms, cls.__name__, cls.needs, others)
        else:
            refuse_unmet(model.terms, f"{cls.__name__} with {options}", needs, [(instead, ())])

    @classmethod
    def _refuse_pairs(cls, model):
        scene, meshes = model.scene, [collider for collider in model.scene.colliders if collider.is_mesh]
        what = "self_contact" if scene.self_contact is not None else f"the mesh collider {meshes[0].label}"
        if not cls.touches_itself:
            able = [record.__name__ for record in SOLVERS.values() if record.touches_itself]
            raise ValueError(f"{cls.__name__} cannot take {what}; {listed(able)} can")
        rubbing = [f"friction on {collider.label}" for collider in meshes if collider.friction]
        if scene.self_contact is not None and scene.self_contact.friction:
            rubbing.insert(0, "friction of self_contact")
        if rubbing and NORMAL_FORCE in cls.needs:
            able = [
                record.__name__ for record in SOLVERS.values() if record.touches_itself and NORMAL_FORCE not in record.needs
            ]
            lack = NORMAL_FORCE.lack.format(label=rubbing[0])
            raise ValueError(f"{cls.__name__} cannot take {lack}; {listed(able)} can, or {NORMAL_FORCE.remedy}")
        if model.mobility is not None and any(each.moves and not each.is_mesh for each in scene.colliders):
            raise ValueError(
                f"{what} is given with vertices that are locked along some axes and a collider that moves and is no mesh, "
                "which it cannot take together"
            )
        if model.threads > 1:
            raise ValueError(f"threads is {model.threads} with {what}, which takes 1")

    @classmethod
    def step_limits(cls, model: Model) -> tuple[float, float]:
        """Returns the largest stable steps [s] about the rest shape and in motion, for a ``limited`` solver."""
        raise NotImplementedError

    def stable(self, h: float, limit: float) -> bool:
        """Returns whether a step h [s] below the smaller of :meth:`step_limits` is stable."""
        return h < limit

    def without_limits(self) -> "Step":
        """Returns the record without its check of limits."""
        return self

    def _on(self, stepper, model):
        """Returns the stepper on a model, or one that divides its copies among threads."""
        return ThreadedStepper(self, stepper, model) if model.threads > 1 else stepper(self, model)

    def __post_init__(self):
        keep_plain(self)
        given = [name for name in self.step_options if getattr(self, name) is not None]
        if len(given) > 1:
            raise ValueError(f"only one of {', '.join(self.step_options[:-1])} and {self.step_options[-1]} may be given")
        for field in fields(self):
            value = getattr(self, field.name)
            if "range" in field.metadata and (value is not None or field.default is not None):
                field.metadata["range"].check(field.name, value)
        for name, words in words_of(type(self)).items():
            choice(name, getattr(self, name), words)

    @property
    def step_given(self) -> bool:
        return any(getattr(self, name) is not None for name in self.step_options)

    def per_frame(self, fps: float) -> int:
        """Returns the number of steps per frame at ``fps``, without a step that nearest to 1/240 s.

        Raises:
            ValueError: ``dt`` does not divide a frame, or divides it into too many steps.
        """
        if self.substeps is not None:
            return self.substeps
        if self.dt is None:
            return max(1, round(_STEPS_A_SECOND / fps))
        steps = 1.0 / max(float(fps) * self.dt, 1e-300)
        if steps > MAX_COUNT:
            raise ValueError(
                f"dt is {self.dt:g} s; at fps {fps:g} a frame must be {MAX_COUNT:,} steps or less, not {steps:.3g}"
            )
        if round(steps) < 1 or abs(steps - round(steps)) > 1e-6 * steps:
            raise ValueError(f"dt is {self.dt:g} s; at fps {fps:g} a frame must be a whole number of steps, not {steps:g}")
        return round(steps)


@dataclass(frozen=True)
class ImplicitStep(Step):
    """The step of a solver that minimises 1/(2hₑ²)‖x − x̃‖²_M + U(x); ``integrator`` determines hₑ and x̃.

    On x″ = −ω²x implicit Euler, of first order, multiplies the energy by 1/(1 + ω²h²) in each step. Midpoint, of second order,
    conserves the energy, and does not damp the noise of stiff springs; it may diverge with too few iterations, or with steps
    that do not resolve rotations. BDF2, of second order, multiplies the energy by about 1 − ω⁴h⁴/2 if ωh is small, and damps
    stiff modes almost at once; ``bind`` takes two Euler steps to find its past state. All three are stable for every h if the
    motion is linear and steps converge.

    Attributes:
        dt, substeps: See :class:`Step`.
        integrator: ``"euler"``, ``"midpoint"`` or ``"bdf2"``, see :mod:`warpcloth.numerics.integrators`.
        error: In place of ``dt`` and ``substeps``, the error [m] that two steps together may add to the position of any vertex
            of any copy. All copies then take steps of h = frame/2^k, k from 1 to 10, see
            :class:`warpcloth.solvers.error_steps.ErrorStepper`. BDF2 does not take it.
    """

    step_options: ClassVar[tuple[str, ...]] = ("dt", "substeps", "error")

    integrator: Literal["euler", "midpoint", "bdf2"] = "euler"
    error: float | None = ranged(None, above=0.0)

    def __post_init__(self):
        super().__post_init__()
        if self.error is not None and not INTEGRATORS[self.integrator].one_step:
            able = " or ".join(repr(name) for name, integrator in INTEGRATORS.items() if integrator.one_step)
            raise ValueError(
                f"error is given with integrator={self.integrator!r}, whose steps must all have one length; take {able}"
            )

    def per_frame(self, fps: float) -> int:
        """Returns the number of steps per frame at ``fps``, with ``error`` the largest one.

        Raises:
            ValueError: As :meth:`Step.per_frame`.
        """
        return super().per_frame(fps) if self.error is None else 2**SHORTEST

    def _on(self, stepper, model):
        if self.error is None:
            return super()._on(stepper, model)
        return ErrorStepper(self, lambda record: record._on(stepper, model), model)

    @property
    def damps(self) -> bool:
        return INTEGRATORS[self.integrator].damps

    def refuse_hard(self, model):
        """Raises ValueError if a stiffness is infinite and the integrator cannot take it."""
        if not INTEGRATORS[self.integrator].hard:
            able = " or ".join(repr(name) for name, integrator in INTEGRATORS.items() if integrator.hard)
            self.refuse(model, (FINITE,), f"integrator={self.integrator!r}", f"integrator={able}")


def fewest_substeps(fps, rest, motion):
    """Returns the fewest steps per frame with a step 10 % below the limit ``rest`` [s], and below ``motion`` [s].

    Raises:
        ValueError: They would be more than a solver takes.
    """
    longest = min(rest / 1.1, motion)
    if not fps * longest * MAX_COUNT > 1.0:
        raise ValueError(f"the scene is so stiff that this solver is stable only below {longest:.3g} s; take an implicit one")
    return math.floor(1.0 / (fps * longest)) + 1
