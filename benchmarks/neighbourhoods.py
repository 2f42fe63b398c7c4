"""Measures the errors of F and D of neighbourhoods in a known motion, against their size and the noise of the points.

    python benchmarks/neighbourhoods.py [--n 33] [--seeds 3] [--waves 2]

Travelling waves stretch, shear and bend an irregular flat sheet of n² vertices and 1 m, so F and D of its tangent plane are
known everywhere. Two frames, 1/60 s apart, have normal noise of a fraction of the mean edge in each coordinate. The script
prints a line for each kind of neighbourhood: its mean number of vertices, the RMS error of F [%], and the RMS error of D
divided by the RMS of D [%]. Each noise is measured over the vertices at least 0.2 m from the boundary; the last columns are the
vertices nearer to it, without noise. Triangles count by their centroids.
"""

import argparse

import numpy as np
from scipy.spatial import Delaunay

import warpcloth as wc

KINDS = (None, "1-ring", "2-ring", "nearest:1%", "nearest:2%", "nearest:5%", "nearest:10%")
NOISE = (0.0, 1e-3, 1e-2)  # of the mean edge
INNER = 0.2  # from the boundary [m]
DT = 1.0 / 60.0  # [s]


def sheet(n):
    """Triangulates n² points of the plane y = 0 (Delaunay); inner points are moved at random by up to 0.3 of the spacing."""
    line = np.linspace(0.0, 1.0, n)
    uv = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    inner = ((uv > 0.0) & (uv < 1.0)).all(axis=1)
    uv[inner] += np.random.default_rng(0).uniform(-0.3, 0.3, (inner.sum(), 2)) / (n - 1)
    triangles = Delaunay(uv).simplices[:, ::-1]
    a, b = (uv[triangles[:, k]] - uv[triangles[:, 0]] for k in (1, 2))
    whole = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) > 1e-3 / n**2  # no slivers from rounding along the boundary
    return wc.Mesh(np.stack([uv[:, 0], np.zeros(n * n), uv[:, 1]], axis=1), triangles[whole])


def motion(points, t, waves):
    """Returns the positions of material points at a time, and their gradients ∂x/∂X and ∂x/∂Z, (n, 3) and (n, 3, 2)."""
    X, _, Z = points.T
    k, rate = 2.0 * np.pi * waves, 2.0 * np.pi  # waves per metre, one per second
    parts = [(0.10, (1.0, 0.4), 0), (0.06, (-0.5, 1.0), 2), (0.10, (0.7, 0.7), 1)]  # size, direction and axis of motion
    x, F = points.copy(), np.zeros((len(X), 3, 2))
    F[:, 0, 0] = F[:, 2, 1] = 1.0
    for size, (along, across), axis in parts:
        phase = k * (along * X + across * Z) - rate * t
        x[:, axis] += size / k * np.sin(phase)
        F[:, axis] += size * np.cos(phase)[:, None] * np.array([along, across])
    return x, F


def known(points, t, waves):
    """Returns F (n, 3, 2) at a time, and D (n, 3, 3) in the tangent plane then."""
    small = 1e-5
    F, (before, after) = motion(points, t, waves)[1], (motion(points, t + s, waves)[1] for s in (-small, small))
    rate = (after - before) / (2.0 * small)
    n = np.cross(F[:, :, 0], F[:, :, 1])
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    L = rate @ np.linalg.pinv(F)
    P = np.eye(3) - n[:, :, None] * n[:, None, :]
    return F, P @ (0.5 * (L + L.mT)) @ P


def errors(mesh, kind, noise, seed, waves):
    """Returns the mean number of vertices, and RMS errors of F and (relative) D, (2,) inside and (2,) near the boundary."""
    edge, rng = mesh.edge_lengths.mean(), np.random.default_rng(seed)
    frames = [motion(mesh.points, t, waves)[0] for t in (0.0, DT)]
    frames = [x + noise * edge * rng.normal(size=x.shape) for x in frames]
    options = {"neighbourhood": kind, "measures": ("deformation_gradient", "rate_of_strain")}
    found = wc.analyze(frames, mesh, dt=DT, **options)
    places, size = (mesh.points[mesh.triangles].mean(axis=1), 3) if kind is None else (mesh.points, members(mesh, kind))
    F, D = found["deformation_gradient"][1], found["rate_of_strain"][1]
    if kind is None:  # from the triangle's own axes to X and Z
        first = mesh.points[mesh.triangles[:, 1]] - mesh.points[mesh.triangles[:, 0]]
        first /= np.linalg.norm(first, axis=1, keepdims=True)
        normal = np.cross(first, mesh.points[mesh.triangles[:, 2]] - mesh.points[mesh.triangles[:, 0]])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        axes = np.stack([first, np.cross(normal, first)], axis=1)  # rows
        F = F @ axes[:, :, [0, 2]]
    else:
        F = F[:, :, [0, 2]]
    exact = known(places, DT, waves)[0], known(places, 0.5 * DT, waves)[1]
    inner = (np.abs(places[:, [0, 2]] - 0.5) < 0.5 - INNER).all(axis=1)
    scale = np.array([1.0, np.sqrt((exact[1] ** 2).sum(axis=(1, 2)).mean())])
    apart = [((a - b) ** 2).sum(axis=(1, 2)) for a, b in zip((F, D), exact, strict=True)]
    return size, *(np.sqrt([each[part].mean() for each in apart]) / scale for part in (inner, ~inner))


def members(mesh, kind):
    """Returns the mean number of vertices of a neighbourhood."""
    from warpcloth.analysis.neighbourhoods import neighbourhoods

    return len(neighbourhoods(mesh, kind)[1]) / len(mesh.points)


def table(n=33, seeds=3, waves=2.0):
    """Returns rows of kind, vertices, and errors of F and D [%]: for each noise the RMS over seeds, then near the boundary."""
    mesh, rows = sheet(n), []
    for kind in KINDS:
        cells = []
        for noise in NOISE:
            found = [errors(mesh, kind, noise, seed, waves) for seed in range(seeds if noise else 1)]
            cells.append(np.sqrt(np.mean([inner**2 for _, inner, _ in found], axis=0)))
            if noise == 0.0:
                (boundary,) = (outer for _, _, outer in found)
        rows.append((kind or "triangle", found[0][0], *(100.0 * np.concatenate([*cells, boundary])).tolist()))
    return rows


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n", type=int, default=33)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--waves", type=float, default=2.0)
    arguments = parser.parse_args()
    heads = [f"{100.0 * noise:g} %" for noise in NOISE] + ["boundary"]
    print("| neighbourhood | vertices | " + " | ".join(f"F, {head} | D, {head}" for head in heads) + " |")
    print("|---" * (2 + 2 * len(heads)) + "|")
    for kind, size, *cells in table(arguments.n, arguments.seeds, arguments.waves):
        print(f"| `{kind}` | {size:.1f} | " + " | ".join(f"{cell:.2g}" for cell in cells) + " |", flush=True)


if __name__ == "__main__":
    main()
