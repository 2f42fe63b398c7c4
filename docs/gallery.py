"""Makes the pictures and films of docs/gallery.md from scenes of the repository: python docs/gallery.py [NAME …]"""

import argparse
import tempfile
import time
import warnings
from dataclasses import replace
from functools import cache
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pictures
from pictures import run
from PIL import Image

import warpcloth as wc
from warpcloth.lab.laboratory import laboratory_readings
from warpcloth.lab.scans import scan
from warpcloth.scenes import (
    bunny,
    cards,
    character,
    curtain,
    cusick,
    drape,
    flag,
    fold,
    funnel,
    hanging,
    knot,
    mobile,
    sleeve,
    stack,
    tablecloth,
    twist,
)

DOCS = Path(__file__).parent
FOLDER = DOCS / "gallery"
# Linear Rec. 709.
WHITE, CREAM, RED, OCHRE, TEAL, INDIGO = (
    (0.82, 0.82, 0.80),
    (0.80, 0.70, 0.52),
    (0.52, 0.04, 0.04),
    (0.74, 0.34, 0.05),
    (0.03, 0.30, 0.30),
    (0.05, 0.09, 0.28),
)
WALK = {"azimuth": -60.0, "elevation": 10.0}
SWING = {"azimuth": -15.0, "elevation": 22.0, "zoom": 1.1, "ground": False}
ENTRIES, RUNS = {}, tempfile.TemporaryDirectory()


def entry(make):
    """Adds a function that makes the file of an entry to those of the command."""
    ENTRIES[make.__name__] = make
    return make


def film(source, name, size=(360, 270), samples=4, **looks):
    """A film that plays in the page."""
    wc.render(source, FOLDER / f"{name}.webp", size=size, samples=samples, **looks)


def page(source, name, **looks):
    """A page that shows a motion in a browser, to which docs/gallery.md links."""
    wc.view(source, DOCS / "_static" / "gallery" / f"{name}.html", **looks)


def bare(animation):
    """The animation without its floor, so that the ground of the picture fades."""
    colliders = [each for each in animation.scene.colliders if not isinstance(each, wc.Plane)]
    return replace(animation, scene=replace(animation.scene, colliders=colliders))


def dyed(animation, kinds, colours):
    """Colours of each triangle in each frame, from the number of its colour."""
    return np.broadcast_to(np.asarray(colours)[kinds], (len(animation.times), len(kinds), 3))


def bands(animation, size, axis=0):
    """Number of the band, so many metres wide, in which each triangle of the rest shape lies along an axis."""
    mesh = animation.scene.mesh
    middle = mesh.points[mesh.triangles].mean(axis=1)[:, axis]
    return np.floor((middle - mesh.points[:, axis].min()) / size).astype(int)


def parts(animation, count):
    """Number of the part of each triangle, of a cloth of so many equal parts."""
    return np.repeat(np.arange(count), len(animation.scene.mesh.triangles) // count)


def gingham(animation, size, dark):
    """White cloth with stripes in both directions, so many metres wide, and dark where they cross."""
    crossed = bands(animation, size, 0) % 2 + bands(animation, size, 2) % 2
    return dyed(animation, crossed, (WHITE, np.sqrt(np.multiply(WHITE, dark)), dark))


@entry
def flag_in_wind():
    animation = run(flag.scene(nx=37, ny=25, swing=0.0, wind=8.0), wc.Newton(substeps=1))
    colour = dyed(animation, bands(animation, 0.2, 2), (INDIGO, WHITE, RED))
    film(animation, "flag_in_wind", colour=colour, frames=(60, None), every=4, azimuth=-15.0, elevation=8.0, ground=-0.9)


@entry
def curtain_drawn():
    animation = run(curtain.scene(nx=37, ny=21), wc.Explicit(substeps=36))
    colour = dyed(animation, bands(animation, 1 / 18) % 2, (TEAL, np.multiply(2.2, TEAL)))
    film(animation, "curtain_drawn", colour=colour, every=4, azimuth=-20.0, elevation=10.0, ground=-1.45)


@entry
def tablecloth_laid():
    animation = run(tablecloth.scene(), wc.Newton(substeps=2))
    film(animation, "tablecloth_laid", colour=gingham(animation, 0.06, RED), every=4, azimuth=-25.0)


@cache
def walking():
    """The animation of the skirt, in a stage that has the whole figure."""
    return run(character.scene(), wc.Newton(substeps=4), output=Path(RUNS.name) / "skirt.usdc")


@entry
def skirt_walking():
    animation = walking()
    colour = dyed(animation, np.zeros(len(animation.scene.mesh.triangles), int), (RED,))
    film(animation.output, "skirt_walking", size=(400, 300), colour=colour, **WALK)


@entry
def twisted():
    animation = run(twist.scene(turns=1.0, around=24, along=20, duration=2.4), wc.Newton())
    colour = dyed(animation, bands(animation, 0.05) % 2, (OCHRE, CREAM))
    film(animation, "twisted", size=(400, 220), colour=colour, every=2, azimuth=-20.0, elevation=14.0, ground=False)


@entry
def knot_tightened():
    animation = run(knot.scene(along=90, across=3), wc.Newton(substeps=2))
    colour = dyed(animation, parts(animation, 2), (RED, INDIGO))
    looks = {"azimuth": -15.0, "elevation": 50.0, "ground": False}
    film(animation, "knot_tightened", size=(400, 220), colour=colour, every=2, **looks)


@entry
def denim_and_silk(names=("denim", "silk")):
    animations = [bare(run(drape.scene(n=41, fabric=name, duration=1.2), wc.Newton(substeps=2))) for name in names]
    dyes = ((INDIGO, np.multiply(1.4, INDIGO)), (CREAM, np.multiply(0.85, CREAM)))
    colour = [dyed(each, bands(each, 0.1) % 2, dye) for each, dye in zip(animations, dyes, strict=True)]
    film(animations, "denim_and_silk", size=(480, 240), names=names, colour=colour, every=4, zoom=1.15)


@entry
def sheets_stacked(sheets=4):
    animation = bare(run(stack.scene(sheets=sheets, n=12), wc.Newton()))
    colour = dyed(animation, parts(animation, sheets), (INDIGO, TEAL, OCHRE, RED))
    film(animation, "sheets_stacked", colour=colour, every=4, elevation=18.0)


@entry
def cards_leaning(frictions=(0.6, 0.15)):
    animations = [bare(run(cards.scene(friction=friction, duration=1.0), wc.Newton(substeps=4))) for friction in frictions]
    names = [f"friction {friction:g}" for friction in frictions]
    colour = [dyed(each, parts(each, 2), (RED, INDIGO)) for each in animations]
    film(
        animations,
        "cards_leaning",
        size=(480, 220),
        names=names,
        colour=colour,
        every=4,
        azimuth=-35.0,
        elevation=20.0,
        zoom=1.1,
    )


@entry
def sheet_folding():
    animation = bare(run(fold.scene(ny=49, duration=0.8), wc.XPBD(substeps=10)))
    colour = dyed(animation, bands(animation, 0.1, 2) % 2, (TEAL, CREAM))
    looks = {"azimuth": -25.0, "elevation": 16.0, "zoom": 1.1}
    film(animation, "sheet_folding", size=(300, 320), colour=colour, every=2, **looks)


@entry
def sleeve_and_lining():
    animation = run(sleeve.scene(), wc.Newton())
    colour = dyed(animation, parts(animation, 2), (INDIGO, OCHRE))
    film(animation, "sleeve_and_lining", size=(400, 220), colour=colour, every=4, azimuth=25.0, ground=False)


@entry
def cloth_in_funnel():
    animation = run(funnel.scene(), wc.Newton())
    film(animation, "cloth_in_funnel", size=(280, 320), colour=gingham(animation, 0.075, TEAL), every=2, elevation=38.0)


@entry
def mobile_turning():
    animation = run(mobile.scene(n=13, push=0.8, duration=3.0), wc.ConstrainedDynamics(substeps=4))
    colour = dyed(animation, parts(animation, 3), (RED, OCHRE, INDIGO))
    film(animation, "mobile_turning", size=(360, 290), colour=colour, every=4, azimuth=-30.0, elevation=14.0)


@entry
def eight_methods():
    solvers = {
        "Explicit": wc.Explicit(substeps=120),
        "Newton": wc.Newton(substeps=4),
        "ProjectiveDynamics": wc.ProjectiveDynamics(substeps=4),
        "ADMM": wc.ADMM(substeps=4),
        "XPBD": wc.XPBD(substeps=10),
        "PBD": wc.PBD(substeps=4),
        "HierarchicalPBD": wc.HierarchicalPBD(substeps=4),
        "ConstrainedDynamics": wc.ConstrainedDynamics(substeps=4),
    }
    animations = [run(hanging.scene(n=16, duration=1.5), solver) for solver in solvers.values()]
    looks = {"colour": "stretch_1", "colour_range": (0.99, 1.01), **SWING}
    film(animations, "eight_methods", size=(740, 290), names=list(solvers), every=4, **looks)


@entry
def three_integrators():
    scene = hanging.scene(n=12, stiffness=100.0, duration=3.0)
    names = ("euler", "bdf2", "midpoint")
    animations = [run(scene, wc.Newton(substeps=4, integrator=name)) for name in names]
    film(animations, "three_integrators", size=(600, 200), names=names, every=4, time=True, **SWING)


@entry
def strain_of_a_capture(frames=36):
    """A synthetic capture of a cape, and beside it the stretch that was measured in it."""
    scene = hanging.scene(n=16)
    true = np.array(run(scene, wc.Newton(substeps=4), frames=frames, dtype="float64").points)
    seen = scan(scene.mesh, true, 1 / scene.fps, spacing=0.05, noise=1e-3, holes=0.1)
    found = wc.resample(seen, scene.mesh, scene.positions, wc.Pins(scene.pins.vertices)).points
    stretch, known = (wc.analyze(each, scene.mesh, measures="stretch")["stretch"][..., 0] for each in (found, true))
    errors = np.linalg.norm(found - true, axis=2), stretch - known
    print("RMS error {:.2g} m, {:.2g} of the stretch".format(*(np.sqrt(np.mean(each**2)) for each in errors)))
    # The surfaces of all frames are one mesh. In each frame only the vertices of its own surface have positions.
    surfaces = list(seen)
    starts = np.cumsum([0, *(len(each.points) for each in surfaces)])
    points = np.full((len(surfaces), starts[-1] + len(scene.mesh.points), 3), np.nan)
    for k, each in enumerate(surfaces):
        points[k, starts[k] : starts[k + 1]] = each.points
    points[:, starts[-1] :] = found + np.array([1.25, 0.0, 0.0])
    captured = np.concatenate([each.triangles + start for each, start in zip(surfaces, starts, strict=False)])
    rests = np.concatenate([*(each.points for each in surfaces), scene.mesh.points])
    mesh = wc.Mesh(rests, np.concatenate([captured, scene.mesh.triangles + starts[-1]]))
    colour = {"stretch": np.hstack([np.ones((len(surfaces), len(captured))), stretch])}
    looks = {"colour": colour, "colour_range": (0.99, 1.01), "colormap": "coolwarm", "azimuth": -20.0, "elevation": 12.0}
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*not finite.*")
        film(
            points, "strain_of_a_capture", size=(560, 300), mesh=mesh, fps=scene.fps, speed=0.5, every=2, ground=False, **looks
        )


@entry
def bunny_turning():
    scene = bunny.scene()
    found = wc.deform(scene.mesh, scene.pins, fps=scene.fps, energy="spokes_and_rims")
    colour = {"rotation [°]": np.degrees(found.angles)}
    looks = {"mesh": scene.mesh, "fps": scene.fps, "colormap": "YlOrRd", "azimuth": -20.0, "elevation": 14.0}
    film(found.points, "bunny_turning", size=(340, 280), colour=colour, every=2, **looks)


@entry
def shadows_of_drapes(names=("silk", "cotton", "canvas", "wool")):
    """Drapes of fabrics above their shadows, with the drape coefficients."""
    scenes = [cusick.scene(name, rows=8) for name in names]
    rests = [wc.equilibrium(scene) for scene in scenes]
    assert all(rest.status.ok for rest in rests)
    drapes = [wc.Mesh(rest.points, scene.mesh.triangles) for rest, scene in zip(rests, scenes, strict=True)]
    figure, axes = plt.subplots(2, len(names), figsize=(2.2 * len(names), 3.7))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "drapes.png"
        wc.render(drapes, path, names=[""] * len(names), size=(280 * len(names), 200), samples=16, ground=False)
        picture = np.asarray(Image.open(path))
    for k, (name, scene, rest) in enumerate(zip(names, scenes, rests, strict=True)):
        (coefficient, _unit), *_ = laboratory_readings(scene, rest).values()
        axes[0, k].imshow(picture[:, 280 * k + 1 : 280 * (k + 1)])
        axes[0, k].set_title(name, color=pictures.GREY, fontsize=10)
        corners = rest.points[scene.mesh.triangles][..., [0, 2]]
        for triangle in corners:
            axes[1, k].fill(*triangle.T, color="0.25", linewidth=0.4)
        axes[1, k].add_patch(plt.Circle((0, 0), cusick.SUPPORT, color="0.25"))
        axes[1, k].add_patch(plt.Circle((0, 0), cusick.RADIUS, fill=False, color="0.6", linestyle=":"))
        axes[1, k].set_aspect("equal")
        axes[1, k].set_xlabel(f"drape coefficient {coefficient:.0f} %", color=pictures.GREY)
    for each in axes.ravel():
        each.set_xticks([])
        each.set_yticks([])
        each.spines[:].set_visible(False)
    figure.tight_layout(pad=0.3)
    pictures.save(figure, "gallery/shadows_of_drapes.png")


@entry
def hanging_in_browser():
    page(run(hanging.scene(n=24, duration=3.0), wc.Newton(substeps=4)), "hanging_in_browser", ground=False)


@entry
def skirt_in_browser():
    page(walking().output, "skirt_in_browser", **WALK)


@entry
def deformation():
    pictures.picture_deformation()


@entry
def cantilever():
    pictures.picture_cantilever()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help="an entry; by default all of them")
    names = parser.parse_args().names or list(ENTRIES)
    for name in names:
        if name not in ENTRIES:
            parser.error(f"{name!r} is no entry; it must be one of {', '.join(ENTRIES)}")
    for name in names:
        started = time.process_time()
        ENTRIES[name]()
        print(f"{name}: {time.process_time() - started:.0f} s", flush=True)
