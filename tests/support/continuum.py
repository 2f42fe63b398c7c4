"""Deforming surfaces by continuum mechanics, in plain NumPy and SciPy: irregular meshes, motions, and what holds of them.

Vectors are columns. Of E elements T (E, 3, 3) = [t₁, t₂, N] is the tangent frame at rest, t₁ along a triangle's first edge, and
F (E, 3, 2) the gradient of the motion along t₁ and t₂.
"""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial import Delaunay
from scipy.spatial.transform import Rotation

import warpcloth as wc
from support.rows import slow_but

EPS = {"float32": np.finfo(np.float32).eps, "float64": np.finfo(np.float64).eps}


def turn(axis, angle):
    """Rotation (3, 3) by an angle [rad] about an axis (3,)."""
    axis = np.asarray(axis, dtype=float)
    return Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).as_matrix()


def skew(w):
    """[w] (3, 3), of which [w] x = w × x."""
    return np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])


def outer(a, b):
    return a[..., :, None] * b[..., None, :]


def along(a, A, b):
    """a·A b of each element."""
    return np.einsum("ei,eij,ej->e", a, A, b)


def symmetric(A):
    return 0.5 * (A + A.mT)


# Errors


def bounded(found, wanted, bound):
    """Finite, and nowhere further from what is wanted than the bound."""
    error = np.abs(found - wanted).max()
    assert error <= bound, f"{error:.2e} > {bound:.2e}"


def rounding(mesh, positions, dtype):
    """2 ε(1 + |x|/a), a the shortest altitude: a side is a difference of positions that are rounded by ε|x|/2 each."""
    size = max(np.abs(x).max() for x in (mesh.points, *positions))
    return 2.0 * EPS[dtype] * (1.0 + size / altitude(mesh.points, mesh.triangles))


# Meshes


def jittered(n=9, seed=0, lift=None, embed=None, st=None):
    """Delaunay triangles of n² points of [0, 1]² moved by up to 0.3/(n − 1), those of the outline along it.

    Args:
        n: Points of a side.
        seed: Of the moves.
        lift: Maps (n², 2) to positions (n², 3); None for the plane of the first two axes.
        embed: Rotation (3, 3) of the positions.
        st: Texture coordinates (2, 2): st = st·(u, v).
    """
    rng = np.random.default_rng(seed)
    line = np.linspace(0.0, 1.0, n)
    uv = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    inner = (uv > 0.0) & (uv < 1.0)
    uv = uv + np.where(inner, rng.uniform(-0.3, 0.3, uv.shape) / (n - 1), 0.0)
    triangles = Delaunay(uv).simplices.astype(np.int32)
    sides = uv[triangles[:, 1:]] - uv[triangles[:, :1]]
    areas = 0.5 * (sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0])
    triangles = triangles[areas > 1e-3 / n**2]  # none but slivers on the outline, which lies on lines up to rounding
    positions = np.pad(uv, ((0, 0), (0, 1))) if lift is None else lift(uv)
    positions = positions if embed is None else positions @ embed.T
    return wc.Mesh(positions, triangles, texture_coordinates=None if st is None else uv @ np.asarray(st).T)


TILT = turn((1.0, 2.0, -1.0), 0.8)


def flat(n=9, seed=0, **given):
    """An irregular flat mesh whose plane is tilted."""
    return jittered(n, seed, embed=TILT, **given)


def hill(uv):
    """A surface of curvature of both signs over the unit square."""
    u, v = uv.T
    return np.stack([u, v, 0.2 * np.sin(3.0 * u) * np.cos(2.0 * v) + 0.1 * u * v], axis=1)


def altitude(points, triangles):
    """The shortest altitude of all triangles [m]."""
    x = points[triangles]
    sides = np.linalg.norm(x - np.roll(x, 1, axis=1), axis=2)
    return (np.linalg.norm(np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]), axis=1) / sides.max(axis=1)).min()


def rings(mesh):
    """Each vertex with those that share a triangle with it, sorted arrays."""
    found = [{i} for i in range(len(mesh.points))]
    for triangle in mesh.triangles.tolist():
        for i in triangle:
            found[i].update(triangle)
    return [np.array(sorted(ring)) for ring in found]


# Kinematics of elements


def normals(points, triangles):
    """Unit normals (E, 3)."""
    x = points[triangles]
    n = np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0])
    return n / np.linalg.norm(n, axis=1, keepdims=True)


def frames(mesh):
    """T (E, 3, 3) of triangles."""
    N = normals(mesh.points, mesh.triangles)
    t1 = mesh.points[mesh.triangles[:, 1]] - mesh.points[mesh.triangles[:, 0]]
    t1 = t1 / np.linalg.norm(t1, axis=1, keepdims=True)
    return np.stack([t1, np.cross(N, t1), N], axis=2)


def gradients(mesh, x):
    """Surface gradients (E, 3, 3) = Σ xᵢ ⊗ ∇φᵢ of triangles, ∇φᵢ = N × eᵢ/2A, eᵢ the side across from corner i."""
    X = mesh.points[mesh.triangles]
    N = normals(mesh.points, mesh.triangles)
    doubled = np.linalg.norm(np.cross(X[:, 1] - X[:, 0], X[:, 2] - X[:, 0]), axis=1)
    across = np.roll(X, -2, axis=1) - np.roll(X, -1, axis=1)
    slopes = np.cross(N[:, None, :], across) / doubled[:, None, None]
    return np.einsum("eia,eib->eab", x[mesh.triangles], slopes)


def strains(F):
    """Of F (E, 3, 2): C = FᵀF, U = √C by its eigenvectors, R = FU⁻¹, E, λ descending, V (E, 2, 2), W = RV, J and n."""
    C = F.mT @ F
    squares, V = np.linalg.eigh(C)
    squares, V = squares[:, ::-1], V[:, :, ::-1]
    V = V * np.where(np.linalg.det(V) < 0.0, -1.0, 1.0)[:, None, None] ** np.array([0, 1])  # right-handed about N
    stretch = np.sqrt(squares)
    R = F @ (V / stretch[:, None, :]) @ V.mT
    cross = np.cross(F[:, :, 0], F[:, :, 1])
    J = np.linalg.norm(cross, axis=1)
    U = (V * stretch[:, None, :]) @ V.mT
    return {
        "C": C,
        "U": U,
        "R": R,
        "E": 0.5 * (C - np.eye(2)),
        "stretch": stretch,
        "V": V,
        "W": R @ V,
        "J": J,
        "n": cross / J[:, None],
    }


def turned(R, T):
    """Angle (E,) of the rotation that takes the frame T to one whose first two vectors are R (E, 3, 2)."""
    whole = np.concatenate([R, np.cross(R[:, :, 0], R[:, :, 1])[:, :, None]], axis=2) @ T.mT
    return Rotation.from_matrix(whole).magnitude()


def rates(F, rate):
    """Rates of a surface with gradient F and its time derivative Ḟ (both (E, 3, 2)), by the product rule.

    L = [Ḟ, ṅ][F, n]⁻¹ with n·F = 0 and so ṅ = −F(FᵀF)⁻¹Ḟᵀn; D in the plane; λ̇/λ = e·De of the principal directions e; Ċ turns
    those in the material by 2λ₁λ₂ e₁·De₂/(λ₁² − λ₂²); and ė₁ = d(Fv₁/λ₁)/dt.
    """
    s = strains(F)
    n, C, stretch, V, e = s["n"], s["C"], s["stretch"], s["V"], s["W"].mT
    n_rate = -(F @ np.linalg.solve(C, rate.mT @ n[:, :, None]))
    L = np.concatenate([rate, n_rate], axis=2) @ np.linalg.inv(np.concatenate([F, n[:, :, None]], axis=2))
    P = np.eye(3) - outer(n, n)
    D = P @ symmetric(L) @ P
    own = np.stack([along(e[:, k], D, e[:, k]) for k in (0, 1)], axis=1)
    gap = stretch[:, 0] ** 2 - stretch[:, 1] ** 2
    rest_turn = 2.0 * stretch.prod(axis=1) * along(e[:, 0], D, e[:, 1]) / gap
    v = V.mT
    first = np.einsum("eij,ej->ei", rate, v[:, 0]) + rest_turn[:, None] * np.einsum("eij,ej->ei", F, v[:, 1])
    first = first / stretch[:, :1] - own[:, :1] * e[:, 0]
    return {
        "velocity_gradient": L,
        "rate_of_strain": D,
        "spin": 0.5 * (L - L.mT),
        "stretch_rate": own,
        "rest_direction_rate": rest_turn,
        "direction_rate": np.cross(e[:, 0], first),
    }


def thread_rates(F, rate, threads):
    """Of material lines Fa, a (E, 2, 2) in columns: ‖Fa‖ and the angle between the two, and l̇/l and the rate of the angle."""
    A, A_rate = F @ threads, rate @ threads
    length = np.linalg.norm(A, axis=1)
    dot, dot_rate = (np.einsum("ei,ei->e", a[:, :, 0], b[:, :, 1]) for a, b in ((A, A), (A_rate, A)))
    dot_rate = dot_rate + np.einsum("ei,ei->e", A[:, :, 0], A_rate[:, :, 1])
    own = np.einsum("eik,eik->ek", A, A_rate) / length**2
    cos = dot / length.prod(axis=1)
    cos_rate = dot_rate / length.prod(axis=1) - cos * own.sum(axis=1)
    return length, np.arccos(cos), own, -cos_rate / np.sqrt(1.0 - cos**2)


# Kinematics of neighbourhoods


def corner_normals(mesh, x):
    """Unit normals of vertices (n, 3), of the sum of the areas of their triangles."""
    corners, total = x[mesh.triangles], np.zeros_like(x)
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    for k in range(3):
        np.add.at(total, mesh.triangles[:, k], areas)
    return total / np.linalg.norm(total, axis=1, keepdims=True)


def fitted(mesh, x, sets):
    """F of a least-squares system of each set with (l̄N, l̄n) as a row, and R and its residual from SciPy, (n, …) each."""
    F, R, residual = [], [], []
    for N, n, ring in zip(corner_normals(mesh, mesh.points), corner_normals(mesh, x), sets, strict=True):
        p, q = (positions[ring] - positions[ring].mean(axis=0) for positions in (mesh.points, x))
        mean = np.sqrt((p**2).sum() / len(p))
        F.append(np.linalg.lstsq(np.vstack([p, mean * N]), np.vstack([q, mean * n]), rcond=None)[0].T)
        found, distance = Rotation.align_vectors(q, p)
        R.append(found.as_matrix())
        residual.append(distance / np.sqrt(len(p)))
    return np.array(F), np.array(R), np.array(residual)


# Motions


def random_map(rng):
    """G (3, 3) with singular values in [0.4, 2], and a translation."""
    U, V = Rotation.random(2, random_state=int(rng.integers(2**31))).as_matrix()
    return (U * rng.uniform(0.4, 2.0, 3)) @ V.T, rng.normal(size=3)


class Affine:
    """x = G(t)X + tb, with the derivative of G."""

    def __init__(self, G, rate, b=(0.0, 0.0, 0.0)):
        self.G, self.rate, self.b = G, rate, np.asarray(b)

    def __call__(self, X, t):
        return X @ self.G(t).T + t * self.b


def constant(L):
    """x = exp(Lt)X, whose velocity gradient is L at all times."""
    return Affine(lambda t: expm(L * t), lambda t: L @ expm(L * t))


def tumbling():
    """Turns and stretches at once, with no two directions alike."""
    w = skew([0.7, -0.4, 0.9])
    A, B = np.diag([1.4, 1.0, 0.7]), np.array([[0.3, 0.2, -0.1], [0.4, -0.2, 0.3], [0.1, -0.3, 0.5]])
    return Affine(
        lambda t: expm(w * t) @ (A + t * B + t * t * B.T),
        lambda t: w @ expm(w * t) @ (A + t * B + t * t * B.T) + expm(w * t) @ (B + 2.0 * t * B.T),
        (0.3, -2.0, 0.7),
    )


# Neo-Hookean membrane


def neo_hookean(F, mu, lam):
    """Energy (E,) and P (E, 3, 2) of u = μ/2(‖F‖² − 2) − μ(J − 1) + ½(λ + μ)(J − 1)², in principal stretches.

    J = λ₁λ₂, and P = W diag(∂u/∂λ) Vᵀ.
    """
    s = strains(F)
    l, J = s["stretch"], s["stretch"].prod(axis=1)
    u = 0.5 * mu * ((l**2).sum(axis=1) - 2.0) - mu * (J - 1.0) + 0.5 * (lam + mu) * (J - 1.0) ** 2
    slopes = mu * l + ((lam + mu) * (J - 1.0) - mu)[:, None] * l[:, ::-1]
    return u, (s["W"] * slopes[:, None, :]) @ s["V"].mT


every_dtype = pytest.mark.parametrize("dtype", slow_but(["float64"], EPS))
on_both = pytest.mark.parametrize("neighbourhood", [None, "1-ring"], ids=["triangles", "vertices"])


def drifting(mesh, t):
    """A motion that no F describes alone."""
    X = mesh.points
    wave = np.stack([np.sin(3.0 * X[:, 1] + t), np.cos(2.0 * X[:, 0] - 2.0 * t), np.sin(X.sum(axis=1) + 3.0 * t)], axis=1)
    return tumbling()(X, t) + 0.1 * wave


def separate(F):
    """A mesh of right triangles, one for each F (E, 3, 2), and its positions: differences that are not rounded."""
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    mesh = wc.Mesh(np.tile(corners, (len(F), 1)), np.arange(3 * len(F)).reshape(-1, 3))
    return mesh, np.concatenate([np.zeros((len(F), 1, 3)), F.mT], axis=1).reshape(-1, 3)
