"""Makes the small pictures in docs/pictures/ of the pages that are made from records: python docs/stills.py [NAME …]"""

import argparse
import json
import re
import tempfile
import time
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import matplotlib
import numpy as np
from PIL import Image

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.figure import Figure

import warpcloth as wc
from warpcloth.chart.style import dress, headline, name_ends, small_print, style_of
from warpcloth.cli import main as command_line
from warpcloth.lab.work_precision import WITHIN
from warpcloth.scenes import cusick, hanging
from warpcloth.solvers import SOLVERS

FOLDER = Path(__file__).parent / "pictures"
STILLS = {}
NEWTON = wc.Newton(substeps=2)


def run(scene, solver, **options):
    """The animation of a run that ends well."""
    animation = wc.simulate(scene, solver, **options)
    assert animation.status.ok, animation.status
    return animation


def at_rest(scene):
    """A scene whose cloth is at rest, or only that cloth if its pins move."""
    rest = wc.equilibrium(scene)
    assert rest.status.ok, rest.status
    if scene.pins.keyframes is not None:  # they say where the pins start, which is not where they are at rest
        return wc.Mesh(rest.points, scene.mesh.triangles)
    return replace(scene, positions=rest.points)


def still(source, name, size=(480, 320), **looks):
    """A picture in docs/pictures/, at most 40 kB."""
    with tempfile.TemporaryDirectory() as folder:
        drawn = wc.render(source, Path(folder) / "still.png", size=size, samples=12, **looks)
        Image.open(drawn).save(FOLDER / f"{name}.webp", quality=82, method=6)


def picture(kind, name):
    """Adds the function that makes the still of a record to those of the command."""

    def add(make):
        STILLS[f"{kind}-{name}"] = make
        return make

    return add


# Scenes: parameters of a size that takes seconds, the moment [s] (None at rest, ... as declared), and the camera.
MOMENTS = {
    "bar_twist": ({}, "deformed", {}),
    "bunny": ({}, "deformed", {}),
    "cantilever": ({"width": 0.3, "elements": 24, "stretching": 1e5}, None, {}),
    "capstan": ({}, 0.3, {"azimuth": 150.0, "elevation": 30.0}),
    "cards": ({}, 1.0, {}),
    "catenary": ({"links": 40}, None, {}),
    "chain": ({}, 0.5, {}),
    "chain_over_edge": ({}, 0.5, {"azimuth": 40.0}),
    "character": ({"duration": 1.0}, 0.8, {}),
    "curtain": ({"nx": 33, "ny": 21}, 2.0, {}),
    "cusick": ({"fabric": "silk", "rows": 10}, None, {}),
    "drape": ({"n": 24}, 1.0, {}),
    "flag": ({"nx": 30, "ny": 20, "swing": 0.0, "wind": 6.0}, 1.5, {}),
    "fold": ({"nx": 8, "ny": 24}, 1.2, {}),
    "folded_sheet": ({"n": 12}, 0.6, {}),
    "funnel": ({"n": 13}, 1.2, {}),
    "hanging": ({}, 0.5, {}),
    "incline": ({}, 0.4, {"azimuth": 0.0, "elevation": 12.0, "zoom": 0.8}),
    "knot": ({"along": 40, "across": 1}, 0.8, {}),
    "loop": ({"kind": "pear"}, None, {}),
    "mobile": ({}, 1.5, {}),
    "net": ({}, ..., {}),
    "overhang": ({"elements": 80}, 0.8, {"azimuth": 40.0}),
    "picture_frame": ({}, None, {}),
    "resting": ({"n": 16, "collider": "sphere"}, ..., {}),
    "ring": ({"elements": 32}, 0.6, {}),
    "sleeve": ({"around": 20, "along": 12}, 1.0, {}),
    "stack": ({"sheets": 3, "n": 10}, 1.2, {}),
    "strip": ({"strain": 0.05}, None, {}),
    "tablecloth": ({"n": 25}, 1.2, {}),
    "twist": ({"around": 16, "along": 14, "turns": 1.0}, 1.0, {}),
    "usd_cloth": ({"duration": 6.0}, 3.5, {}),
    "winding": ({"layers": 4, "width": 0.12, "edge": 0.02, "duration": 0.2}, 0.2, {"azimuth": 25.0, "elevation": 12.0}),
}


def still_of_scene(name):
    parameters, moment, looks = MOMENTS[name]
    scene = import_module(f"warpcloth.scenes.{name}").scene(**parameters)
    if moment == "deformed":
        source = wc.deform(scene.mesh, scene.pins, fps=scene.fps, energy="spokes_and_rims")
    elif moment is None:
        source = at_rest(scene)
    elif moment is ...:
        source = scene
    else:
        solver = wc.ConstrainedDynamics(substeps=4) if name == "mobile" else NEWTON
        source = run(scene, solver, frames=round(moment * scene.fps))
    still(source, f"scene-{name}", **looks)


for _name in MOMENTS:
    picture("scene", _name)(lambda name=_name: still_of_scene(name))


# Energies: two sheets that differ in the energy, by their names in the picture.
SHEET = wc.Mesh.grid(17, 17, pattern="alternating")
STRIP = wc.Mesh.grid(9, 17, size=(0.4, 0.8), pattern="alternating")
CORNERS, EDGE = "corners and z == 0", "z == 0"
NET = wc.Spring(pairs=("structural", "shear"), stiffness=300.0)
SOFT = wc.Spring(pairs=("structural", "shear"), stiffness=20.0)


def hung(name, *terms, mesh=SHEET, pins=CORNERS, **fields):
    """A cloth that hangs from pins."""
    return wc.Scene(mesh, density=0.2, terms=terms, pins=pins, name=name, **fields)


def moved(name, *terms, solver=NEWTON, seconds=0.6, **fields):
    """The motion of a cloth that hangs from pins."""
    return run(hung(name, *terms, **fields), solver, frames=round(60 * seconds))


def pulled(name, energy):
    """A strip at rest, pulled down by its own weight."""
    points = STRIP.points[:, [0, 2, 1]] * [1.0, -1.0, 1.0]
    return at_rest(
        hung(
            name,
            energy,
            mesh=wc.Mesh(STRIP.points, STRIP.triangles, texture_coordinates=STRIP.points[:, [0, 2]]),
            pins=EDGE,
            positions=points,
        )
    )


def clamped(name, *terms, mesh=SHEET, rows=0.07, **fields):
    """A sheet that is clamped along one side and bends under its weight, at rest."""
    return at_rest(
        wc.Scene(mesh, density=0.2, terms=[wc.Spring(stiffness=3e3), *terms], pins=f"z < {rows}", name=name, **fields)
    )


def gutter():
    """Half a tube, curved at rest."""
    mesh = wc.Mesh.grid(17, 17, size=(1.0, 1.0), pattern="alternating")
    angle = np.pi * (mesh.points[:, 0] - mesh.points[:, 0].min()) - 0.5 * np.pi
    return wc.Mesh(np.stack([np.sin(angle) / np.pi, np.cos(angle) / np.pi, mesh.points[:, 2]], axis=1), mesh.triangles)


ENERGIES = {
    "Attachment": lambda: [
        moved("pins", NET),
        moved("attachments", NET, wc.Attachment(vertices=CORNERS, stiffness=8.0), pins=None),
    ],
    "CorotatedMembrane": lambda: [pulled(f"k = {k:g} N/m", wc.CorotatedMembrane(stiffness=k)) for k in (20.0, 2.5)],
    "DihedralBending": lambda: [clamped(f"D = {D:g} N·m", wc.DihedralBending(stiffness=D)) for D in (1e-4, 1e-1)],
    "NeoHookeanMembrane": lambda: [
        pulled(f"Poisson's ratio {ν:g}", wc.NeoHookeanMembrane(stiffness=5.0, poisson_ratio=ν)) for ν in (0.0, 0.45)
    ],
    "OrthotropicMembrane": lambda: [
        pulled(name, wc.OrthotropicMembrane(stiffness=20.0, shear_ratio=0.05, warp_angle=angle))
        for name, angle in (("along the warp", 0.0), ("at 45°", np.pi / 4))
    ],
    "PlateBending": lambda: [
        clamped(name, wc.PlateBending(stiffness=0.1, weft_ratio=0.01, warp=warp))
        for name, warp in (("stiff along z", (0.0, 0.0, 1.0)), ("stiff along x", (1.0, 0.0, 0.0)))
    ],
    "QuadraticBending": lambda: [clamped(f"D = {D:g} N·m", wc.QuadraticBending(stiffness=D)) for D in (1e-4, 1e-1)],
    "RigidCluster": lambda: [
        moved("springs", NET),
        moved("a rigid cluster", NET, wc.RigidCluster(vertices="z > 0.3", stiffness=1e5), seconds=0.45),
    ],
    "ShellBending": lambda: [
        clamped(kind.__name__, kind(stiffness=1e-1), mesh=gutter()) for kind in (wc.PlateBending, wc.ShellBending)
    ],
    "Spring": lambda: [
        moved(name, wc.Spring(pairs=pairs, stiffness=300.0))
        for name, pairs in (("structural", "structural"), ("structural and shear", ("structural", "shear")))
    ],
    "SpringLimit": lambda: [
        moved("springs", SOFT, solver=wc.XPBD(substeps=16)),
        moved("springs with limits", SOFT, wc.SpringLimit(most=1.05, stiffness=np.inf), solver=wc.XPBD(substeps=16)),
    ],
    "StVKMembrane": lambda: [
        pulled(f"Poisson's ratio {ν:g}", wc.StVKMembrane(stiffness=5.0, poisson_ratio=ν)) for ν in (0.0, 0.45)
    ],
    "StrainLimit": lambda: [
        moved("membrane", wc.CorotatedMembrane(stiffness=20.0), solver=wc.XPBD(substeps=16)),
        moved(
            "membrane with limits",
            wc.CorotatedMembrane(stiffness=20.0),
            wc.StrainLimit(most=1.05, stiffness=np.inf),
            solver=wc.XPBD(substeps=16),
        ),
    ],
}
for _name, _pair in ENERGIES.items():
    picture("energy", _name)(lambda name=_name, pair=_pair: still(pair(), f"energy-{name}", size=(640, 320)))


# Solvers: one moment of the hanging cloth, with the options that the solver needs.
STEPS = {"Explicit": {"substeps": 128}, "XPBD": {"substeps": 16}, "ADMM": {"substeps": 4}}


def still_of_solver(record):
    scene = hanging.scene(n=24)
    animation = run(scene, record(**STEPS.get(record.__name__, {"substeps": 4})), frames=30)
    still(animation, f"solver-{record.__name__}", colour="stretch_1", colour_range=(0.99, 1.01))


for _record in SOLVERS.values():
    picture("solver", _record.__name__)(lambda record=_record: still_of_solver(record))


# Charts of speed, one solver in its colour; the points of `warpcloth chart work-precision hanging -p n=32 --workers 1 --json`.
POINTS = FOLDER / "work-precision.json"


def still_of_speed(record):
    found = json.loads(POINTS.read_text(encoding="utf-8"))
    figure = Figure(figsize=(6.4, 4.4), layout="constrained", dpi=110)
    axes, ends, style = figure.subplots(), [], style_of(record.name)
    lines = {}
    for row in found["rows"]:
        if row["status"] == "ok":
            lines.setdefault((row["solver"], row["options"].get("integrator", "euler")), []).append(row)
    for (solver, integrator), rows in lines.items():
        rows.sort(key=lambda row: row["ms_per_second"])
        x, y = ([row[of] for row in rows] for of in ("ms_per_second", "error"))
        if solver == record.name:
            axes.plot(x, y, linewidth=1.2, markersize=5, zorder=3, **style.line)
            ends.append((x[-1], y[-1], solver if integrator == "euler" else f"{solver} {integrator}", style.colour))
        else:
            axes.plot(x, y, ".-", color="0.82", linewidth=0.8, markersize=4, zorder=1)
    axes.set(xscale="log", yscale="log", xlabel="ms for a second of motion", ylabel="error: RMS of all vertices, over the size")
    axes.axhline(WITHIN, color="0.5", linestyle="--", linewidth=0.8)
    axes.annotate(f"{WITHIN:.0%}", (1.0, WITHIN), (-2, 2), ("axes fraction", "data"), "offset points", ha="right", fontsize=8)
    dress(axes)
    headline(figure, f"{found['scene']}, {found['frames']} frames, {found['dtype']}; grey: the other solvers")
    small_print(figure, found["machine"])
    name_ends(figure, axes, ends)
    with tempfile.TemporaryDirectory() as folder:
        figure.savefig(Path(folder) / "still.png", facecolor="white")
        Image.open(Path(folder) / "still.png").convert("RGB").save(
            FOLDER / f"speed-{record.__name__}.webp", quality=70, method=6
        )


for _record in SOLVERS.values():
    picture("speed", _record.__name__)(lambda record=_record: still_of_speed(record))


# Fabrics: their numbers among those of the others, and the drapes of those with all numbers.
NUMBERS = {
    "density": "ρ [kg/m²]",
    "warp": "E₁t [N/m]",
    "weft": "E₂t [N/m]",
    "shear": "Gt [N/m]",
    "bending_warp": "D₁ [N·m]",
    "bending_weft": "D₂ [N·m]",
}


def still_of_fabric(fabric):
    figure, every = plt.figure(figsize=(4.8, 2.6), dpi=150), list(wc.fabrics.values())
    for row, (field, label) in enumerate(NUMBERS.items()):
        axes = figure.add_axes((0.17, 0.86 - 0.155 * row, 0.8, 0.1))
        values = [getattr(each, field) for each in every if getattr(each, field) is not None]
        axes.plot(values, np.zeros(len(values)), "o", color="0.75", markersize=4)
        own = getattr(fabric, field)
        if own is not None:
            axes.plot([own], [0.0], "o", color="#d55e00", markersize=7)
        axes.set(xscale="log", yticks=[], ylim=(-1, 1))
        axes.set_ylabel(label if own is not None else f"{label}\nunknown", rotation=0, ha="right", va="center", fontsize=8)
        axes.spines[["top", "right", "left"]].set_visible(False)
        axes.tick_params(labelsize=7, pad=1)
        axes.minorticks_off()
    with tempfile.TemporaryDirectory() as folder:
        figure.savefig(Path(folder) / "still.png", facecolor="white")
        Image.open(Path(folder) / "still.png").save(FOLDER / f"fabric-{fabric.name}.webp", quality=82, method=6)
    plt.close(figure)


def still_of_drape(name):
    still(at_rest(cusick.scene(name, rows=8)), f"drape-{name}", size=(320, 320), elevation=90.0, ground=False)


for _fabric in wc.fabrics.values():
    picture("fabric", _fabric.name)(lambda fabric=_fabric: still_of_fabric(fabric))
    try:
        _fabric.terms()
    except ValueError:  # a number that was not measured
        continue
    picture("drape", _fabric.name)(lambda fabric=_fabric: still_of_drape(fabric.name))


# Failures by the numbers of the table in stability.md: options that make maps of few cells, which take seconds.
MAPS = {
    "2": "--x-range 0 0.4 5 --y-range 1e-3 1e-1 5 --duration 0.1 --steps 10",
    "3": "--x-range 1e-2 1e2 5 --y-range 1 64 5 --duration 0.2 --steps 20",
    "4": "-p n=5 --x-range 1 64 5 --y-range 0.1 1 6 --duration 0.2 --steps 20",
    "5": "-p n=5 --x-range 1 64 5 --y-range 0.25 4 5 --duration 0.2 --steps 20",
    "6": "-p n=5 --x-range 1e-1 1e4 6 --y-range 1 64 5 --duration 0.25 --at dt=1/240",
    "7": "-p n=5 --x-range 1e-1 1e4 6 --y-range 1e-2 10 5 --duration 0.25 --at dt=1/240",
    "8": "-p n=5 --x-range 1e-1 1e4 6 --y-range 1 64 5 --duration 0.25 --at dt=1/240",
    "10": "",
    "11": "",
    "12": "",
    "13": "",
    "14": "--x-range 8 64 4 --y-range 1 64 5 --duration 0.2 --steps 20",
}


def charts():
    """Commands of the charts of failures by number, from the table of stability.md."""
    text = (FOLDER.parent / "stability.md").read_text(encoding="utf-8")
    return dict(re.findall(r"^\| (\d+) \| .* \| `(.*?)`.* \|$", text, re.MULTILINE))


def still_of_failure(number):
    with tempfile.TemporaryDirectory() as folder:
        drawn = f"{folder}/chart.png"
        assert command_line(["chart", *charts()[number].split(), *MAPS[number].split(), "-o", drawn]) == 0
        chart = Image.open(drawn).convert("RGB")
        chart.thumbnail((900, 900))
        chart.save(FOLDER / f"failure-{number}.webp", quality=55, method=6)


for _number in MAPS:
    picture("failure", _number)(lambda number=_number: still_of_failure(number))


def main(names=()):
    """Makes the pictures of some names, or all."""
    FOLDER.mkdir(exist_ok=True)
    for name in names or STILLS:
        start = time.process_time()
        STILLS[name]()
        print(
            f"{name:<28} {time.process_time() - start:6.1f} s  {(FOLDER / f'{name}.webp').stat().st_size:6} bytes", flush=True
        )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="those to make, of all if none is given")
    main(parser.parse_args().names)
