"""The scene and the solver of the arguments of a command."""

import math
import time
import warnings
from dataclasses import asdict, dataclass, replace

from ..base.texts import assignments, options
from .options import DEFAULT, add_cloth, add_scene, add_solver, add_values

# With more substeps per frame than this, print a hint at the implicit solver.
_MANY_SUBSTEPS = 1000

EPILOG = """\
If no step is given, by dt, substeps or error, it is about 1/240 s for most solvers. Solvers with a stability limit, such as
explicit, take the fewest substeps that respect two limits. The first, with a margin of 10 %, is for small motion about the
rest shape. The second is for large motion. It is a strict bound for springs and quadratic bending, but only an estimate for
dihedral bending and membranes, because it uses their stiffness at rest.
"""


def add_scene_and_solver(parser, text):
    """Adds the scene and the solver of a command; ``text`` says what the solver is for."""
    add_scene(parser)
    add_solver(parser, text)
    add_values(parser, "-s", "option", "options of the solver")
    add_cloth(parser)


def named_scene(arguments):
    """Returns (source, values of its parameters, scene) of the arguments."""
    from ..run.scene_files import find_source

    source = find_source(arguments.scene, getattr(arguments, "pins", None))
    values = source.values(_parameters(arguments))
    return source, values, source.scene(values)


def scene_ref(arguments):
    """Returns the :class:`warpcloth.lab.measurements.SceneRef` of the arguments."""
    from ..lab.measurements import SceneRef

    return SceneRef(arguments.scene, _parameters(arguments), arguments.pins)


def _parameters(arguments):
    """Returns the parameters of the scene as texts by name, after moving options that stand for some of them to ``-p``."""
    for name in getattr(arguments, "of_scene", ()):
        if (value := getattr(arguments, name)) is not None:
            arguments.p = [*arguments.p, f"{name}={value}"]
            setattr(arguments, name, None)
    return assignments(arguments.p)


def warn_of_seams(mesh, scene=None):
    """Warns of vertices that lie upon others along seams, unless terms of a scene join them: the cloth is cut there."""
    from ..mesh.seams import seam_pairs

    pairs = seam_pairs(mesh.points, mesh.triangles)
    joined = (
        [pair for term in scene.terms for pair in term.held(mesh, scene.positions)[0].tolist()] if scene and len(pairs) else ()
    )
    loose = {*map(frozenset, pairs.tolist())} - {*map(frozenset, joined)}
    if loose:
        warnings.warn(
            f"{len(loose)} vertices lie upon others along seams and nothing joins them, so the cloth is cut there; weld them "
            "in the program that made the mesh",
            stacklevel=2,
        )


@dataclass
class Chosen:
    """A solver, and how its step was chosen.

    Attributes:
        dtype: The precision of the run.
        solver: The solver with its options, as shown.
        checked: The solver to run, without a check of limits that are known to hold.
        chosen: How its step was chosen, or None if it was given.
        limits: The result of ``step_limits``, if it was computed.
        seconds: Time to build a model and compute the limits [s].
    """

    dtype: str
    solver: object = None
    checked: object = None
    chosen: str | None = None
    limits: tuple | None = None
    seconds: float = 0.0


def solver_setup(arguments, scene, device, limits=False):
    """Returns the solver of the arguments; ``limits`` asks for the limits of a limited solver even if its step is given."""
    from ..solvers import SOLVERS

    arguments.solver = arguments.solver or DEFAULT
    record = SOLVERS[arguments.solver]
    dtype = record.precision_on(device, arguments.dtype)
    solver = record(**options(record, assignments(arguments.s)))  # checks options before anything is built
    step_given = solver.step_given
    if not (record.limited or step_given):
        solver = replace(solver, substeps=solver.per_frame(scene.fps))
        return Chosen(dtype, solver, solver, "by default about 1/240 s")
    if step_given and not (record.limited and limits):
        return Chosen(dtype, solver, solver)
    from ..mesh.ordering import order_of_run
    from ..solvers.step import fewest_substeps

    began = time.perf_counter()
    rest, motion = record.step_limits(scene.build(device=device, dtype=dtype, order=order_of_run(scene, solver)))
    setup = Chosen(dtype, solver, solver, None, (rest, motion), time.perf_counter() - began)
    if not step_given:
        setup.solver = replace(solver, substeps=fewest_substeps(scene.fps, rest, motion))
        setup.chosen = f"by default the fewest stable ones, limits {rest:.3g} and {motion:.3g} s"
    setup.checked = setup.solver
    if setup.solver.stable(1.0 / (scene.fps * setup.solver.per_frame(scene.fps)), min(rest, motion)):
        setup.checked = setup.solver.without_limits()  # so that they are not computed twice
    return setup


def fewest_below(fps, limit):
    """Returns the fewest substeps per frame with a step below ``limit`` [s]."""
    return math.floor(1.0 / (fps * limit)) + 1


def hint_of(arguments, setup, scene):
    """Returns a hint at a faster solver, or None."""
    substeps = setup.solver.per_frame(scene.fps)
    if not setup.solver.limited or substeps <= _MANY_SUBSTEPS:
        return None
    return f"warpcloth: hint: {setup.solver.name} takes {substeps:,} substeps a frame here; --solver {DEFAULT} may suit better"


def solver_facts(arguments, setup, fps):
    by_error = getattr(setup.solver, "error", None) is not None
    step = None if by_error else 1.0 / (fps * setup.solver.per_frame(fps))
    return {"solver": arguments.solver, "options": asdict(setup.solver), "step": step, "step_chosen": setup.chosen}


def solver_line(facts):
    options = ", ".join(f"{name}={value}" for name, value in facts["options"].items() if value is not None)
    step = "by error" if facts["step"] is None else f"1/{1.0 / facts['step']:.6g} s"
    return f"{facts['solver']}({options}), step {step}" + (f" ({facts['step_chosen']})" if facts["step_chosen"] else "")
