"""Deformation gradients of meshes that are refined: the order at which they become that of a smooth map."""

import numpy as np
import pytest

import warpcloth as wc
from support.continuum import frames, jittered


def waves(uv):
    """A smooth map of the unit square to a curved surface that is stretched, and its gradient (n, 3, 2)."""
    u, v = uv.T
    x = np.stack(
        [1.1 * u + 0.1 * np.sin(3.0 * v), v + 0.15 * np.sin(2.0 * u + v), 0.2 * np.sin(3.0 * u) * np.cos(2.0 * v)], axis=1
    )
    c = 0.15 * np.cos(2.0 * u + v)
    F = np.array([
        [1.1 + 0.0 * u, 0.3 * np.cos(3.0 * v)],
        [2.0 * c, 1.0 + c],
        [0.6 * np.cos(3.0 * u) * np.cos(2.0 * v), -0.4 * np.sin(3.0 * u) * np.sin(2.0 * v)],
    ])  # fmt: skip
    return x, np.moveaxis(F, 2, 0)


def errors_of(mesh, neighbourhood, device):
    """‖F − ∇x‖ of each element, ∇x at the centroid of a triangle or at the vertex; of vertices with n as the third column."""
    uv = mesh.points[:, [2, 0]] if np.ptp(mesh.points[:, 2]) > 0 else mesh.points[:, :2]  # grids face y, which is z × x
    basis = np.eye(3)[:, [2, 0, 1]] if np.ptp(mesh.points[:, 2]) > 0 else np.eye(3)
    found = wc.analyze([waves(uv)[0]], mesh, measures="deformation_gradient", neighbourhood=neighbourhood, device=device)
    F = found["deformation_gradient"][0]
    if neighbourhood is None:
        gradient = waves(uv[mesh.triangles].mean(axis=1))[1]
        return np.linalg.norm(F - gradient @ (basis[:, :2].T @ frames(mesh)[:, :, :2]), axis=(1, 2))
    gradient = waves(uv)[1]
    n = np.cross(gradient[:, :, 0], gradient[:, :, 1])
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    return np.linalg.norm(F - np.concatenate([gradient, n[:, :, None]], axis=2) @ basis.T, axis=(1, 2))


# Sets that are their own image in their vertex lose the second derivative, of first order; all others keep it.
REGULAR = {"1-ring, inner": ("1-ring", 0.05, 2), "2-ring, inner": ("2-ring", 0.15, 2), "1-ring, outline": ("1-ring", None, 1)}
MESHES = {
    "diagonal": lambda n: wc.Mesh.grid(n, n, pattern="diagonal"),
    "alternating": lambda n: wc.Mesh.grid(n, n, pattern="alternating"),
    "irregular": lambda n: jittered(n, seed=n),
}
LEVELS = (17, 33, 65)


@pytest.mark.parametrize("region", REGULAR)
@pytest.mark.parametrize("kind", MESHES)
def test_fitted_gradients_converge(kind, region, device):
    """F of neighbourhoods is of second order inside regular meshes, of first order inside irregular ones and on outlines."""
    neighbourhood, depth, order = REGULAR[region]
    order = 1 if kind == "irregular" else order
    errors = []
    for n in LEVELS:
        mesh = MESHES[kind](n)
        error = errors_of(mesh, neighbourhood, device)
        if depth is None:
            kept = mesh.boundary
        else:
            planar = mesh.points[:, np.ptp(mesh.points, axis=0) > 0]
            kept = np.flatnonzero(((planar > depth) & (planar < planar.max(axis=0) - depth)).all(axis=1))
        errors.append(np.sqrt((error[kept] ** 2).mean()))
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    print(f"{kind}, {region}: {errors}, orders {orders}")
    # What is left of the next order; of irregular meshes the scatter of RMS over their random moves.
    assert np.abs(orders - order).max() < (0.2 if kind == "irregular" else 0.12)


@pytest.mark.parametrize("kind", MESHES)
def test_gradients_of_triangles_converge(kind, device):
    """F of a triangle is of first order at its centroid."""
    errors = [np.sqrt((errors_of(MESHES[kind](n), None, device) ** 2).mean()) for n in LEVELS]
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    print(f"{kind}: {errors}, orders {orders}")
    assert np.abs(orders - 1.0).max() < 0.1
