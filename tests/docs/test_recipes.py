"""Computes the wrong figure of each recipe in docs/recipes.md, beside the right one."""

from pathlib import Path

import numpy as np
import pytest
from scipy.sparse import coo_array, diags_array
from scipy.sparse.linalg import splu

import warpcloth as wc
from support.continuum import TILT, flat, turn
from warpcloth.core.constant_matrix import constant_matrices
from warpcloth.deformation.arap import half_cotangents
from warpcloth.scenes import hanging

PAGE = (Path(__file__).parents[2] / "docs" / "recipes.md").read_text(encoding="utf-8")


def absolute_cotangents():
    """Interpolates a linear function over a net of long triangles; the largest error divided by its range [%]."""
    mesh = flat(17)
    mesh = wc.Mesh((mesh.points @ TILT) * [3.0, 1.0, 1.0], mesh.triangles)
    values, n, errors = mesh.points[:, 0] + mesh.points[:, 1], len(mesh.points), []
    free = np.setdiff1d(np.arange(n), mesh.boundary)
    opposite = mesh.triangles[:, [[1, 2], [2, 0], [0, 1]]].reshape(-1, 2)
    for weights in (np.abs(half_cotangents(mesh)), half_cotangents(mesh)):
        W = coo_array((weights.ravel(), tuple(opposite.T)), shape=(n, n)).tocsr()
        W = W + W.T
        laplacian = (diags_array(W.sum(axis=1)) - W).tocsr()
        right = -laplacian[free][:, mesh.boundary] @ values[mesh.boundary]
        found = splu(laplacian[free][:, free].tocsc()).solve(right)
        errors.append(100.0 * np.abs(found - values[free]).max() / np.ptp(values))
    return errors


def gradient_from_two_axes():
    """The least stretch of a sheet that is turned by 60° and not deformed."""
    mesh = wc.Mesh.grid(5, 5)
    x = mesh.points @ turn((1.0, 0.0, 0.0), np.radians(60.0)).T
    corners = [points[mesh.triangles][:, :, [0, 2]] for points in (mesh.points, x)]  # two of three axes
    Dm, Ds = (np.stack([c[:, 1] - c[:, 0], c[:, 2] - c[:, 0]], axis=2) for c in corners)
    wrong = np.linalg.svd(Ds @ np.linalg.inv(Dm), compute_uv=False).min()
    return wrong, wc.analyze([x], mesh, measures=("stretch",))["stretch"].min()


def dome(height):
    """A vertex above a ring of six, (7, 3) about their mean."""
    angles = np.arange(6) * np.pi / 3.0
    ring = np.stack([np.cos(angles), 0.0 * angles, np.sin(angles)], axis=1)
    points = np.concatenate([[[0.0, height, 0.0]], ring])
    return points - points.mean(axis=0)


def reflection():
    """det R of the best rotation of a small dome that pops through."""
    P, Q = dome(0.3), dome(-0.3)
    U, _, Vt = np.linalg.svd(Q.T @ P)  # Q ≈ R P
    return np.linalg.det(U @ Vt), np.linalg.det(wc.kabsch(P[None], Q[None])[0])


def covariance_for_gradient():
    """The ratio of the principal stretches of a cloth whose cells are twice as long as wide, not deformed, in its middle."""
    mesh = wc.Mesh.grid(7, 7, size=(2.0, 1.0), pattern="alternating")
    found = wc.analyze([mesh.points], mesh, neighbourhood="1-ring", measures=("cross_covariance", "stretch"))
    middle = 24
    values = np.linalg.svd(found["cross_covariance"][0, middle], compute_uv=False)
    return values[0] / values[1], found["stretch"][0, middle, 0] / found["stretch"][0, middle, 1]


def roots_of_eigenvalues():
    """The share of NaN among stretches √λ(FᵀF) of triangles that have collapsed to a line, in float32 [%]."""
    rng = np.random.default_rng(0)
    F = (rng.normal(size=(10_000, 3, 1)) * rng.normal(size=(10_000, 1, 2))).astype(np.float32)
    with np.errstate(invalid="ignore"):
        wrong = np.sqrt(np.linalg.eigvalsh(F.mT @ F))
    return [100.0 * np.isnan(each).any(axis=1).mean() for each in (wrong, wc.svd(F)[1])]


def lost_digits():
    """The error of the smaller stretch 1e-4 of 10,000 triangles whose other is 1, in float32, median [%]."""
    rng = np.random.default_rng(1)
    U = np.linalg.qr(rng.normal(size=(10_000, 3, 2)))[0]
    V = np.linalg.qr(rng.normal(size=(10_000, 2, 2)))[0]
    F = ((U * [1.0, 1e-4]) @ V.mT).astype(np.float32)
    exact = np.linalg.svd(F.astype(np.float64), compute_uv=False)[:, 1]
    squares = np.linalg.eigvalsh(F.mT @ F)[:, 0]
    smaller = (np.sqrt(np.maximum(squares, 0.0)), wc.svd(F)[1][:, 1])
    return [100.0 * np.median(np.abs(each / exact - 1.0)) for each in smaller]


def rate_of_shear():
    """γ̇ of simple shear x = X + t Z by e₁·D e₂, and by the rate of the angle [1/s]."""
    mesh, dt = wc.Mesh.grid(5, 5), 1e-3
    frames = [mesh.points + t * mesh.points[:, [2]] * [1.0, 0.0, 0.0] for t in (-0.5 * dt, 0.5 * dt)]
    found = wc.analyze(frames, mesh, dt=dt, directions=(1.0, 0.0, 0.0), measures=("rate_of_strain", "angle_rate"))
    return found["rate_of_strain"][1, 0, 0, 2], np.abs(found["angle_rate"][1, 0])


def transposed_inverse():
    """The width of the 1 m square of `hanging` after a step at rest, solved by (M/h² + Σ kGᵀG)ᵀ and ⁻¹ [m]."""
    scene = hanging.scene(n=8)
    model = scene.build(dtype="float64")
    (A,) = constant_matrices(model, 240.0**2)
    right = A @ scene.mesh.points
    return [np.ptp(found[:, 0]) for found in (A.T @ right, splu(A.tocsc()).solve(right))]


RECIPES = {
    "cotangents": absolute_cotangents,
    "two axes": gradient_from_two_axes,
    "reflection": reflection,
    "covariance": covariance_for_gradient,
    "eigenvalues": roots_of_eigenvalues,
    "digits": lost_digits,
    "shear": rate_of_shear,
    "transpose": transposed_inverse,
}


# Figures that rounding decides differ between processors by a few per cent.
ROUNDED = {"eigenvalues": 0.1, "digits": 0.1}


def row(name):
    """Reads the figures of a recipe from the page: what it gives and what is right."""
    (cells,) = (line.split("|")[1:-1] for line in PAGE.splitlines() if line.startswith(f"| `{name}` |"))
    return [float(cell.split()[0]) for cell in cells[-2:]]


@pytest.mark.parametrize("name", RECIPES)
def test_recipes(name):
    """The row of the page, to its two digits: what the recipe gives, and what is right, where this project has it."""
    wrong, right = RECIPES[name]()
    said = row(name)
    assert said[0] == pytest.approx(wrong, rel=ROUNDED.get(name, 0.01))
    assert said[1] == pytest.approx(right, rel=ROUNDED.get(name, 0.01), abs=1e-6)
    assert abs(wrong - right) > 0.25 * max(abs(wrong), abs(right)), "nothing is wrong with it"


def test_the_page_has_all_recipes():
    assert [line.split("`")[1] for line in PAGE.splitlines() if line.startswith("| `")] == list(RECIPES)


if __name__ == "__main__":
    for name, recipe in RECIPES.items():
        print(f"{name:<12}", *(f"{value:.3g}" for value in recipe()))
