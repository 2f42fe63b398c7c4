"""Makes the pictures of the README and of docs/ from animations and equilibria: python docs/pictures.py"""

import tempfile
from dataclasses import replace
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from stills import main as picture_records
from stills import run

import warpcloth as wc
from warpcloth.chart.style import LEGEND, dress, series_style, small_print
from warpcloth.cli.reports import ReportFiles, ReportLooks, write_report
from warpcloth.lab import elastica
from warpcloth.scenes import bar_twist, bunny, cantilever, character, cusick, hanging, mobile, tablecloth

DOCS = Path(__file__).parent
GREY = "0.35"


def save(figure, name):
    """A PNG in docs/, cut to what is drawn."""
    figure.savefig(DOCS / name, dpi=130, bbox_inches="tight", pad_inches=0.08, facecolor="white")
    plt.close(figure)


def picture_hanging():
    """The hanging cloth as a GIF in real time, and a frame of it in the colours of a measure."""
    animation = run(replace(hanging.scene(n=64, duration=2.4), fps=25), wc.Newton(substeps=10))
    wc.render(animation, DOCS / "hanging.gif", size=(560, 315), samples=8, time=True)
    wc.render(animation, DOCS / "stretch.png", size=(960, 540), samples=16, time=True, frame=48, colour="stretch_1")


def picture_cantilever(gammas=(1.0, 5.0, 20.0), elements=40):
    """Vertices of the cantilever at rest on the elastica; its one row of triangles bends with 8/9 of D."""
    figure, axes = plt.subplots(figsize=(4.6, 3.6), layout="constrained")
    for k, gamma in enumerate(gammas):
        colour = series_style(k).colour
        scene = cantilever.scene(gamma=8 / 9 * gamma, elements=elements)
        rest = wc.equilibrium(scene)
        assert rest.status.ok, rest.status
        clamp = scene.mesh.points[scene.pins.vertices, 0].max() / 2
        points = rest.points[:, :2] - [clamp, 0.0]
        axes.plot(*elastica.curve(gamma).T, "-", color=colour, linewidth=1.6, zorder=2)
        axes.plot(*points[: elements + 1 : 2].T, "o", color=colour, markersize=4.5, markerfacecolor="white", zorder=3)
        axes.annotate(f"Γ = {gamma:g}", points[elements], (8, -4), textcoords="offset points", color=colour)
    axes.plot([], [], "-", color=GREY, label="elastica")
    axes.plot([], [], "o", color=GREY, markersize=4.5, markerfacecolor="white", label="vertices at rest, every second")
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 0.98), ncols=2, **LEGEND)
    axes.set_aspect("equal")
    axes.margins(x=0.08)
    axes.set(xlabel="x / L", ylabel="y / L")
    dress(axes)
    small_print(figure)
    save(figure, "cantilever.png")


def picture_deformation(frames=(0, 16, 32, 48), most=150.0):
    """Frames of bar_twist below each other, two of bunny beside them, coloured by the angle of rotation up to ``most`` [°]."""
    points, triangles, angles = [], [], []
    left = 0.0
    for scene, chosen, size in ((bar_twist.scene(), frames, 1.0), (bunny.scene(), frames[::3], 1.25)):
        found = wc.deform(scene.mesh, scene.pins, fps=scene.fps, energy="spokes_and_rims")
        assert found.converged.all()
        stacked = scene.name == "bar_twist"
        down = 0.0
        for frame in chosen:
            part = found.points[frame] * size / np.ptp(scene.mesh.points, axis=0).max()
            part = part - [part[:, 0].min() - left, part[:, 1].max() - down, 0.0]
            triangles.append(scene.mesh.triangles + sum(map(len, points)))
            points.append(part)
            angles.append(np.degrees(found.angles[frame]))
            left, down = (left, part[:, 1].min() - 0.08) if stacked else (part[:, 0].max() + 0.15, down)
        left = max(each[:, 0].max() for each in points) + 0.2
    mesh = wc.Mesh(np.concatenate(points), np.concatenate(triangles))
    colour = {"rotation [°]": np.concatenate(angles)[None]}
    looks = {"colour": colour, "colour_range": (0.0, most), "colormap": "YlOrRd", "ground": False}
    wc.render(mesh, DOCS / "deformation.png", size=(1430, 540), samples=16, azimuth=-20.0, elevation=14.0, **looks)


def picture_mobile(moments=(0.0, 1.0, 2.0, 3.0)):
    """The mobile side by side at some moments [s], drawn as the cloths of a batch."""
    scene = mobile.scene(n=13, push=0.8)
    animation = run(scene, wc.ConstrainedDynamics(substeps=4), frames=round(moments[-1] * scene.fps))
    chosen = np.asarray(animation.points)[None, [round(time * scene.fps) for time in moments]]
    animation = replace(animation, points=chosen, times=animation.times[:1])
    wc.render(animation, DOCS / "mobile.png", size=(1430, 400), samples=16, azimuth=-30.0, elevation=14.0)


def picture_drape():
    """A drape of the cotton from above and from the side."""
    scene = cusick.scene("cotton", rows=8)
    rest = wc.equilibrium(scene)
    assert rest.status.ok, rest.status
    shape = wc.Mesh(rest.points, scene.mesh.triangles)
    for name, elevation in (("drape-above.png", 90.0), ("drape-side.png", 14.0)):
        wc.render(shape, DOCS / name, size=(480, 360), samples=16, elevation=elevation, ground=False)


def picture_contact():
    """The tablecloth on its table, and the figure that walks in its skirt in real time, from the stages of their runs."""
    with tempfile.TemporaryDirectory() as folder:
        laid, walking = (Path(folder) / name for name in ("tablecloth.usdc", "character.usdc"))
        run(tablecloth.scene(), wc.Newton(substeps=2), output=laid)
        wc.render(laid, DOCS / "tablecloth.png", size=(720, 405), samples=16)
        run(character.scene(), wc.Newton(substeps=4), output=walking)
        wc.render(walking, DOCS / "character.gif", size=(320, 264), samples=8, azimuth=-60.0, elevation=10.0)


def picture_analysis(n=32, frame=20):
    """A frame of the hanging cloth with its first principal stretch and both directions, as `analyze` makes it."""
    scene = hanging.scene(n=n)
    animation = run(scene, wc.Newton(dt=1 / 240), frames=frame)
    analyzer = wc.Analyzer(animation, scene.mesh, measures=("stretch", "directions"))
    write_report(analyzer, ReportFiles(stills={frame: DOCS / "analysis.png"}), ReportLooks(curves=True))


if __name__ == "__main__":
    picture_analysis()
    picture_hanging()
    picture_mobile()
    picture_contact()
    picture_drape()
    picture_deformation()
    picture_cantilever()
    picture_records()
