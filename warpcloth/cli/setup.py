"""The scene and the solver that the arguments of a command name."""

import math
import time
from dataclasses import asdict, dataclass, replace

from ..base.outputs import STAGE_ENDINGS
from ..base.texts import assignments, options
from .options import DEFAULT

# A step that all solvers without a limit take well; where no step is given the substeps come nearest to it.
_STEPS_A_SECOND = 240
# More substeps a frame than this, and the implicit solver is worth a hint.
_MANY_SUBSTEPS = 1000

EPILOG = """\
If neither dt nor substeps is given, the step is chosen: about 1/240 s for most solvers. Solvers with a stability limit, such as
explicit, take the fewest substeps that respect two limits. The first, with a margin of 10 %, is for small motion about the
rest shape. The second is for large motion. It is a strict bound for springs and quadratic bending, but only an estimate for
dihedral bending and membranes, because it uses their stiffness at rest.
"""


def named_scene(arguments):
    """(source, values of its parameters, scene) that the arguments name."""
    from ..run.scene_files import find_source

    source = find_source(arguments.scene, getattr(arguments, "pins", None))
    prim = getattr(arguments, "prim", None)
    if prim is not None:  # a parameter of a stage like others, so measurements in other processes get it too
        if source.path.suffix not in STAGE_ENDINGS:
            raise ValueError(f"--prim is given, but {arguments.scene} is not a stage; leave it out")
        arguments.p, arguments.prim = [*arguments.p, f"prim={prim}"], None
    values = source.values(assignments(arguments.p))
    return source, values, source.scene(values)


@dataclass
class Chosen:
    """A solver, and what had to be built to choose its step.

    Attributes:
        solver: With its options, as they are shown.
        checked: The same to be run; it does not look for limits again that are known to be kept.
        chosen: How its step was chosen, or None where it was given.
        model: Of the scene, if it is built already.
        limits: As ``step_limits`` gives them, if they were asked for.
        seconds: What building and the limits took.
    """

    solver: object = None
    checked: object = None
    chosen: str | None = None
    model: object = None
    limits: tuple | None = None
    seconds: float = 0.0


class Built:
    """A scene whose model stands already."""

    def __init__(self, scene, model):
        self._scene, self._model = scene, model

    def __getattr__(self, name):
        return getattr(self._scene, name)

    def build(self, **_):
        """The model, whose device and precision are those of the whole command."""
        return self._model


def solver_setup(arguments, scene, device, limits=False):
    """Returns the solver that the arguments name; ``limits`` asks for those of a limited one even where its step is given."""
    from ..solvers import SOLVERS

    arguments.solver = arguments.solver or DEFAULT
    record = SOLVERS[arguments.solver]
    given = options(record, assignments(arguments.s))
    step_given = "dt" in given or "substeps" in given
    solver = record(**given, **({} if step_given else {"substeps": 1}))  # a wrong option is said before anything is built
    if not record.limited:
        if step_given:
            return Chosen(solver, solver)
        solver = replace(solver, substeps=max(1, round(_STEPS_A_SECOND / scene.fps)))
        return Chosen(solver, solver, "by default about 1/240 s")
    if step_given and not limits:
        return Chosen(solver, solver)
    from ..mesh.ordering import order_of_run
    from ..solvers.step import fewest_substeps

    began = time.perf_counter()
    model = scene.build(
        device=device, dtype=arguments.dtype, order=order_of_run(scene, solver), threads=getattr(arguments, "threads", 1)
    )
    rest, motion = record.step_limits(model)
    setup = Chosen(solver, solver, None, model, (rest, motion), time.perf_counter() - began)
    if not step_given:
        setup.solver = replace(solver, substeps=fewest_substeps(scene.fps, rest, motion))
        setup.chosen = f"by default the fewest stable ones, limits {rest:.3g} and {motion:.3g} s"
    setup.checked = setup.solver
    if setup.solver.stable(1.0 / (scene.fps * setup.solver.per_frame(scene.fps)), min(rest, motion)):
        setup.checked = setup.solver.without_limits()  # which leaves out a second search for them
    return setup


def fewest_below(fps, limit):
    """The fewest substeps a frame whose step is below ``limit``."""
    return math.floor(1.0 / (fps * limit)) + 1


def hint_of(arguments, setup, scene):
    """A line for those who may wait longer than they need, or None."""
    substeps = setup.solver.per_frame(scene.fps)
    if not setup.solver.limited or substeps <= _MANY_SUBSTEPS:
        return None
    return f"warpcloth: hint: {setup.solver.name} takes {substeps:,} substeps a frame here; --solver {DEFAULT} may suit better"


def solver_facts(arguments, setup, fps):
    step = 1.0 / (fps * setup.solver.per_frame(fps))
    return {"solver": arguments.solver, "options": asdict(setup.solver), "step": step, "step_chosen": setup.chosen}


def solver_line(facts):
    options = ", ".join(f"{name}={value}" for name, value in facts["options"].items() if value is not None)
    return f"{facts['solver']}({options}), step 1/{1.0 / facts['step']:.6g} s" + (
        f" ({facts['step_chosen']})" if facts["step_chosen"] else ""
    )
