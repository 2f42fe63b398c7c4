"""The command ``choose``: the cheapest solver and settings that meet a tolerance for a scene, on this machine."""

import shlex
import sys

from ..base.quiet import find_device
from ..base.texts import assignments, fraction, json_text, milliseconds
from .options import add_cloth, add_scene, add_shared, add_with, values_of
from .setup import named_scene, scene_ref
from .terminal import Interrupted, Settings

TEXT = "Choose the cheapest solver and settings for a scene."
EPILOG = """\
--tolerance finds the cheapest setting with at most this error, --budget the most accurate setting within this time, and both
together the cheapest setting that meets both. The settings of each solver are tried from coarse to fine. A solver is done when
a setting meets the tolerance, exceeds the budget, or takes longer than the fastest setting found to meet the tolerance. Each
solver of --with is searched until its own fastest setting is found, or for six times --limit. The error is the RMS distance
over vertices and frames to a reference solution, divided by the longest side of the cloth. Measurements are stored and reused.

  warpcloth choose hanging -p n=32 --tolerance 1%
  warpcloth choose hanging --budget 16ms
"""


def add_arguments(parser):
    """Adds the arguments of this command."""
    add = parser.add_argument
    add_scene(parser)
    add_cloth(parser)
    text = "largest error allowed, as a share of the size of the cloth, such as 1%%; needed unless --budget is given"
    add("--tolerance", metavar="SHARE", help=text)
    add("--budget", metavar="TIME", help="longest time per frame allowed, such as 16ms; needed unless --tolerance is given")
    add("--solvers", nargs="+", metavar="SOLVER", help="solvers to choose among (default: all)")
    add_with(parser)
    add("--frames", type=int, metavar="N", help="number of frames to simulate (default: those of the scene's duration)")
    add("--limit", type=float, default=60.0, metavar="SECONDS", help="time limit of each run (default: 60)")
    add_shared(parser, "device", "json", "dtype")


def choose(arguments):
    device = find_device(arguments.device)
    choice, found, exact, values = choice_for(arguments, device)
    from ..lab.choosing import as_json
    from ..solvers import SOLVERS

    known = choice.chosen is not None and choice.chosen.setup.solver in SOLVERS  # run has no solvers of other simulators
    command = None if not known else command_line(arguments, values, choice.chosen.setup)
    facts = {"scene": arguments.scene, "parameters": values, **as_json(choice, found, exact), "command": command}
    advise = shlex.join(["warpcloth", "info", *_scene(arguments, values), "--advise"])
    print(json_text(facts) if arguments.json else _text(facts, choice, found, exact, advise))
    return 0


def choice_for(arguments, device):
    """Returns the choice for the arguments, all measurements, the reference, and the parameters of the scene."""
    from ..lab.choosing import choose

    _source, values, _scene = named_scene(arguments)
    tolerance = None if arguments.tolerance is None else fraction("tolerance", arguments.tolerance)
    budget = None if arguments.budget is None else milliseconds("budget", arguments.budget)
    progress = Settings()
    try:
        choice, found, exact = choose(
            scene_ref(arguments),
            tolerance,
            budget,
            device=str(device),
            progress=progress,
            **values_of(arguments, "solvers", "frames", "dtype", "limit"),
            others=getattr(arguments, "others", None) or (),
            announce=_announce,
        )
    except KeyboardInterrupt:
        raise Interrupted(
            "interrupted; the settings that are measured are kept, and the same command goes on from there"
        ) from None
    finally:
        progress.close()
    return choice, found, exact, values


def _announce(longest):
    """Prints how long a choice may take."""
    parts = [f"{_time(longest.reference)} for the reference", f"{_time(longest.limit)} for each of {longest.settings} settings"]
    if longest.others:
        parts.append(f"{_time(longest.other)} for each of {longest.others} solvers of other simulators")
    print(f"warpcloth: takes at most {_time(longest.seconds)}, without compilation: {', '.join(parts)}", file=sys.stderr)


def _time(seconds):
    return f"{seconds:.3g} s" if seconds < 90.0 else f"{seconds / 60.0:,.0f} min"


def take_choice(arguments, device):
    """Sets the solver and options of a run to those chosen for its tolerance and budget.

    Raises:
        ValueError: They are given, or nothing meets tolerance and budget.
    """
    for name, given in (("--solver", arguments.solver), ("-s", arguments.s)):
        if given:
            raise ValueError(f"{name} is given, and --tolerance or --budget chooses it; leave one out")
    arguments.solvers, arguments.limit = None, 60.0
    choice, _found, _exact, _values = choice_for(arguments, device)
    if not choice.meets:
        raise ValueError(f"nothing meets --tolerance and --budget: {choice.certainty}")
    setup = choice.chosen.setup
    print(f"warpcloth: chosen: {setup}; {choice.certainty}", file=sys.stderr)
    arguments.solver, arguments.s = setup.solver, [f"{name}={value}" for name, value in setup.options.items()]


def command_line(arguments, values, setup):
    """Returns the command line that runs a scene with a setup."""
    words = ["warpcloth", "run", *_scene(arguments, values)]
    words += ["--solver", setup.solver, "-s", *(f"{name}={value}" for name, value in setup.options.items())]
    words += [] if arguments.frames is None else ["--frames", str(arguments.frames)]
    words += [] if arguments.device == "cpu" else ["--device", arguments.device]
    return shlex.join([*words, "--dtype", setup.precision_on(arguments.device, arguments.dtype), "-o", "out.usdc"])


def _scene(arguments, values):
    """Returns the words that name the scene on a command line."""
    given = [f"{name}={value}" for name, value in values.items() if name in assignments(arguments.p)]
    imports = [word for module in arguments.imports for word in ("--import", module)]
    pins = [] if arguments.pins is None else ["--pins", arguments.pins]
    return [arguments.scene, *imports, *pins, *(["-p", *given] if given else [])]


def _text(facts, choice, found, exact, advise):
    from ..lab.choosing import percent
    from ..lab.own_reference import words_of_own
    from ..lab.setups import grid_in_words
    from ..others.simulators import shown_name

    measured = f"{facts['scene']}: {len(found)} settings measured over {len(exact.points) - 1} frames"
    lines = [f"{measured}; the reference is known to {percent(exact.error)}"]
    width = max((len(str(each.setup)) for each in found), default=0)
    for each in sorted(found, key=lambda each: (each.milliseconds is None, each.milliseconds or 0.0)):
        name = str(each.setup).ljust(width)
        if each.error is None or each.milliseconds is None:
            lines.append(f"  {name}  {each.reason or 'no error'}")
        else:
            lines.append(
                f"  {name}  {each.milliseconds:9.3g} ms  {percent(each.error):>9}"
                + (f"  {percent(each.own_error)} from its own" if each.own_error is not None else "")
                + ("" if each.usable else "  not usable")
                + ("  chosen" if each is choice.chosen else "")
            )
    for solver, own in choice.others.items():
        same = [each.setup.options for each in found if each.setup.solver == solver]
        lines.append(f"  {shown_name(solver)}: own motion {words_of_own(own if len(own) > 1 else None)}")
        lines.append(f"  {shown_name(solver)}: {own['searched']}; substeps × iterations: {grid_in_words(same)}")
    lines += [f"  measured on {name}" for name in dict.fromkeys(each.machine for each in found)]
    if choice.untried and found:
        lines.append(f"{choice.untried} settings were not tried: coarser ones of their solvers meet it, cost more or fail")
    lines.append(choice.certainty)
    lines.append(f"errors are those on this mesh; whether a finer mesh, air or anisotropy matters: {advise}")
    return "\n".join([*lines, *([facts["command"]] if facts["command"] else [])])
