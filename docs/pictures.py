"""Makes the pictures of the README and of docs/ from animations and rest shapes: python docs/pictures.py"""

from dataclasses import replace
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, LogNorm, Normalize
from PIL import Image

import warpcloth as wc
from warpcloth.cli.reports import write_report
from warpcloth.lab import elastica
from warpcloth.picture.picture import paint
from warpcloth.picture.view import View, brightness
from warpcloth.scenes import bar_twist, bunny, cantilever, hanging, mobile

DOCS = Path(__file__).parent
GREY = "0.35"
COLOURS = ListedColormap(plt.get_cmap("viridis")(np.linspace(0.25, 1.0, 256)))


def save(figure, name):
    """A PNG in docs/, cut to what is drawn."""
    figure.savefig(DOCS / name, dpi=130, bbox_inches="tight", pad_inches=0.08, facecolor="white")
    plt.close(figure)


def strain(mesh, points):
    """Mean of l/L − 1 over the edges of a vertex, averaged over each triangle, (T,)."""
    lengths = [np.linalg.norm(np.diff(x[mesh.edges], axis=1)[:, 0], axis=1) for x in (points, mesh.points)]
    ends, repeated = mesh.edges.ravel(), np.repeat(lengths[0] / lengths[1] - 1.0, 2)
    at_vertices = np.bincount(ends, repeated) / np.bincount(ends)
    return at_vertices[mesh.triangles].mean(axis=1)


def draw(axes, mesh, seen, values, colours):
    """The triangles of a mesh from the back to the front, coloured by values from 0 to 1 (T,)."""
    corners = seen[mesh.triangles]
    faces = colours(np.clip(values, 0.0, 1.0))
    faces[:, :3] *= brightness(corners, 0.7)[:, None]
    # Edges in the colour of their triangle close the hairlines between neighbours.
    paint(axes, corners[..., :2], corners[..., 2].mean(axis=1), faces, 0.4)


def finish(figure, axes, colours, norm, ticks, label, extend="neither"):
    """Sets equal scales, hides the axes, and adds a colour bar with ticks."""
    axes.set_aspect("equal")
    axes.autoscale_view()
    axes.axis("off")
    scale = ScalarMappable(norm, colours)
    bar = figure.colorbar(scale, ax=axes, shrink=0.6, aspect=14, pad=0.01, extend=extend)
    bar.set_ticks(ticks, labels=[f"{tick:.3g}" for tick in ticks], minor=False)
    bar.minorticks_off()
    bar.set_label(label, color=GREY, fontsize=8)
    bar.ax.tick_params(labelsize=8, colors=GREY)
    bar.outline.set_visible(False)


def picture_hanging(fps=25, colours=256, least=1e-4):
    """Makes a GIF of the hanging cloth in real time, coloured by strain from ``least`` to the largest of the run."""
    scene = replace(hanging.scene(n=64, duration=2.4), fps=fps)
    animation = wc.simulate(scene, wc.Newton(substeps=10))
    assert animation.status.ok, animation.status
    frames = np.asarray(animation.points, dtype=float)
    most = max(strain(scene.mesh, points).max() for points in frames)
    norm = LogNorm(100.0 * least, 100.0 * most)  # the strain at the pins is a hundred times that of the rest
    view = View(elevation=18.0)
    left, right, bottom, top = view.fit(frames).window
    figure, axes = plt.subplots(figsize=(5.2, 3.2), layout="constrained", dpi=110)
    finish(figure, axes, COLOURS, norm, [0.01, 0.1, 1.0, 100.0 * most], "strain [%]", "min")
    images = []
    for k, points in enumerate(frames):
        seen = view.project(points)
        draw(axes, scene.mesh, seen, norm(100.0 * np.maximum(strain(scene.mesh, points), least)), COLOURS)
        axes.plot(*seen[scene.pins.vertices, :2].T, "o", color="black", markersize=4.0)
        axes.text(left, bottom, f"{k / fps:.2f} s", color=GREY, fontsize=8)
        axes.set(xlim=(left, right), ylim=(bottom, top))
        figure.canvas.draw()
        images.append(Image.fromarray(np.asarray(figure.canvas.buffer_rgba())[..., :3]))
        for artist in [*axes.collections, *axes.lines, *axes.texts]:
            artist.remove()
    plt.close(figure)
    # One palette for all frames, so that what stands still is stored once, with a white that is white.
    sample = Image.fromarray(np.concatenate([np.asarray(image) for image in images[::6]]))
    entries = np.array(sample.quantize(colours).getpalette())
    entries[entries > 248] = 255
    palette = Image.new("P", (1, 1))
    palette.putpalette(entries.tolist())
    images = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    images[0].save(DOCS / "hanging.gif", save_all=True, append_images=images[1:], duration=1000 // fps, loop=0, optimize=True)


def picture_cantilever(gammas=(1.0, 5.0, 20.0), elements=40):
    """Vertices of the cantilever at rest on the elastica; its one row of triangles bends with 8/9 of D."""
    figure, axes = plt.subplots(figsize=(4.6, 3.6))
    colours = plt.get_cmap("viridis")([0.1, 0.45, 0.7])
    for gamma, colour in zip(gammas, colours, strict=True):
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
    axes.legend(frameon=False, fontsize=8, labelcolor=GREY, loc="lower right", bbox_to_anchor=(1.0, 0.98), ncols=2)
    axes.set_aspect("equal")
    axes.margins(x=0.08)
    axes.set_xlabel("x / L", color=GREY)
    axes.set_ylabel("y / L", color=GREY)
    axes.tick_params(colors=GREY, labelsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color("0.7")
    save(figure, "cantilever.png")


def picture_deformation(frames=(0, 16, 32, 48), most=150.0):
    """Frames of bar_twist below each other and of bunny beside them, coloured by the angle of rotation up to ``most`` [°]."""
    figure, axes = plt.subplots(figsize=(11.0, 3.4))
    left = 0.0
    for scene, azimuth, gap in ((bar_twist.scene(), -30.0, 0.05), (bunny.scene(), 25.0, 0.1)):
        found = wc.deform(scene.mesh, scene.pins, fps=scene.fps, energy="spokes_and_rims")
        assert found.converged.all()
        size = np.ptp(scene.mesh.points[:, 1]) * (3.2 if scene.name == "bar_twist" else 0.5)
        down = 0.0
        for frame in frames if scene.name == "bar_twist" else frames[::3]:
            seen = View(azimuth, 18.0).project(found.points[frame] / size)
            seen[:, :2] += [left - seen[:, 0].min(), down - seen[:, 1].max()]
            draw(axes, scene.mesh, seen, np.degrees(found.angles[frame])[scene.mesh.triangles].mean(axis=1) / most, COLOURS)
            if scene.name == "bar_twist":
                down = seen[:, 1].min() - gap
            else:
                left = seen[:, 0].max() + gap
        left = max(left, seen[:, 0].max() + 0.3)
    finish(figure, axes, COLOURS, Normalize(0.0, most), [0.0, most / 2, most], "rotation [°]")
    save(figure, "deformation.png")


def picture_mobile(moments=(0.0, 1.0, 2.0, 3.0)):
    """The mobile side by side at some moments [s]: strings and bars black, cloths in one colour."""
    scene = mobile.scene(n=13, push=0.8)
    animation = wc.simulate(scene, wc.ConstrainedDynamics(substeps=4), frames=round(moments[-1] * scene.fps))
    assert animation.status.ok, animation.status
    bodies, strings = scene.terms[:2]
    bars = [bodies.vertices[:3][[1, 0, 2]], bodies.vertices[3:6][[1, 0, 2]]]
    figure, axes = plt.subplots(figsize=(11.0, 3.4))
    left = 0.0
    for time in moments:
        seen = View(-30.0, 14.0).project(np.asarray(animation.points[round(time * scene.fps)], dtype=float))
        seen[:, 0] += left - seen[:, 0].min()
        draw(axes, scene.mesh, seen, np.full(len(scene.mesh.triangles), 0.6), COLOURS)
        for line in [*bars, *strings.pairs]:
            axes.plot(*seen[line, :2].T, "-", color="black", linewidth=1.6 if len(line) == 3 else 0.7)
        right = seen[:, 0].max()
        axes.text((left + right) / 2, 0.1, f"{time:g} s", ha="center", color=GREY)
        left = right + 0.2
    axes.set_aspect("equal")
    axes.axis("off")
    save(figure, "mobile.png")


def picture_analysis(n=32, frame=20):
    """A frame of the hanging cloth with its first principal stretch and both directions, as `analyze` makes it."""
    scene = hanging.scene(n=n)
    animation = wc.simulate(scene, wc.Newton(dt=1 / 240), frames=frame)
    assert animation.status.ok, animation.status
    analyzer = wc.Analyzer(animation, scene.mesh, measures=("stretch", "directions"))
    write_report(analyzer, stills={frame: DOCS / "analysis.png"}, curves=True)


if __name__ == "__main__":
    picture_analysis()
    picture_hanging()
    picture_mobile()
    picture_deformation()
    picture_cantilever()
