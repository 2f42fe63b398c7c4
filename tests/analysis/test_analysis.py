"""Measures of deforming surfaces against continuum mechanics: affine maps, closed forms, objectivity."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import warpcloth as wc
from support.continuum import (
    EPS,
    TILT,
    bounded,
    drifting,
    every_dtype,
    fitted,
    flat,
    frames,
    gradients,
    hill,
    jittered,
    on_both,
    outer,
    random_map,
    rings,
    rounding,
    separate,
    strains,
    turn,
    turned,
)
from warpcloth.analysis.measures import MEASURES

STATIC = ("deformation_gradient", "rotation", "right_stretch", "right_cauchy_green", "green_strain", "stretch",
          "rest_directions", "directions", "rotation_angle", "area_ratio")  # fmt: skip
RATES = ("velocity_gradient", "rate_of_strain", "spin", "stretch_rate", "rest_direction_rate", "direction_rate")
METHODS = ("midpoint", "forward", "logarithm")


# Affine maps


def check_triangles(found, k, F, T, bound):
    """Row k of all that follows from F, where it is known to a bound on what |F| ≤ 2 is."""
    s = strains(F)
    low, gap = s["stretch"][:, 1].min(), ((s["stretch"][:, 0] - s["stretch"][:, 1]) / s["stretch"][:, 0])[:, None, None]
    bounded(found["deformation_gradient"][k], F, 2.0 * bound)
    for name, wanted in (("right_cauchy_green", s["C"]), ("green_strain", s["E"]), ("area_ratio", s["J"])):
        bounded(found[name][k], wanted, 4.0 * 2.0 * bound)
    bounded(found["stretch"][k], s["stretch"], 2.0 * bound)
    # R and U turn by up to the error of F over λ₁ + λ₂, directions by that over λ₁ − λ₂.
    bounded(found["rotation"][k], s["R"], 2.0 * bound / low)
    bounded(found["right_stretch"][k], s["U"], 4.0 * bound / low)
    bounded(found["rotation_angle"][k], turned(s["R"], T), 4.0 * bound / low)
    for name, axes in (("rest_directions", T[:, :, :2] @ s["V"]), ("directions", s["W"])):
        d = found[name][k].astype(np.float64)
        bounded(np.linalg.norm(d, axis=2), 1.0, bound)
        for i in (0, 1):  # of either sign
            bounded(gap * outer(d[:, i], d[:, i]), gap * outer(axes[:, :, i], axes[:, :, i]), 8.0 * bound / low)


@every_dtype
@pytest.mark.parametrize("mesh", [flat(), jittered(lift=hill)], ids=["flat", "curved"])
def test_affine_maps_of_triangles(mesh, dtype, device):
    """F = GT, and what follows from it, on every triangle, though no two are alike."""
    rng = np.random.default_rng(1)
    maps = [random_map(rng) for _ in range(6)]
    positions = [mesh.points @ G.T + b for G, b in maps]
    found = wc.analyze(positions, mesh, measures=STATIC, dtype=dtype, device=device)
    T, bound = frames(mesh), rounding(mesh, positions, dtype)
    for k, (G, _) in enumerate(maps):
        check_triangles(found, k, G @ T[:, :, :2], T, bound)
    assert not found.excluded


@every_dtype
def test_any_motion_of_triangles(dtype, device):
    """F = Σ xᵢ ⊗ ∇φᵢ T of the linear functions φᵢ of the rest shape's corners."""
    mesh = jittered(lift=hill)
    positions = [drifting(mesh, t) for t in (0.0, 0.3, 0.6)]
    found = wc.analyze(positions, mesh, measures=STATIC, dtype=dtype, device=device)
    T, bound = frames(mesh), rounding(mesh, positions, dtype)
    for k, x in enumerate(positions):
        check_triangles(found, k, gradients(mesh, x) @ T[:, :, :2], T, bound)


@every_dtype
def test_warp_and_weft_of_texture_coordinates(dtype, device):
    """Lines along which s grows and t does not, and the reverse; at rest they need not be square to one another."""
    st = np.array([[2.0, 0.9], [-0.3, 1.5]])
    mesh, (G, b) = flat(st=st), random_map(np.random.default_rng(9))
    lines = TILT[:, :2] @ np.linalg.inv(st)
    lines /= np.linalg.norm(lines, axis=0)
    positions = [mesh.points, mesh.points @ G.T + b]
    found = wc.analyze(positions, mesh, measures=("length_ratio", "angle"), directions="st", dtype=dtype, device=device)
    bound = rounding(mesh, positions, dtype)
    for k, A in enumerate((lines, G @ lines)):
        bounded(found["length_ratio"][k], np.linalg.norm(A, axis=0), 4.0 * bound)
        cos = A[:, 0] @ A[:, 1] / np.linalg.norm(A, axis=0).prod()
        assert k or abs(cos) > 0.1
        bounded(found["angle"][k], np.arccos(cos), 8.0 * bound / np.linalg.norm(A, axis=0).min())


def nearest(mesh, k):
    distance = np.linalg.norm(mesh.points[:, None] - mesh.points[None], axis=2)
    return np.argsort(distance, axis=1)[:, :k]


def near(mesh, radius):
    distance = np.linalg.norm(mesh.points[:, None] - mesh.points[None], axis=2)
    return [np.flatnonzero(row <= radius) for row in distance]


def second_rings(mesh):
    first = rings(mesh)
    return [np.unique(np.concatenate([first[j] for j in ring])) for ring in first]


SETS = {
    "1-ring": rings,
    "2-ring": second_rings,
    "nearest:k=12": lambda mesh: nearest(mesh, 12),
    "nearest:radius=0.3": lambda mesh: near(mesh, 0.3),
    "nearest:20%": lambda mesh: nearest(mesh, 17),  # of 81
}


@every_dtype
@pytest.mark.parametrize("neighbourhood", SETS)
def test_affine_maps_of_neighbourhoods(neighbourhood, dtype, device):
    """On a flat mesh F = GP + nNᵀ, P the projection to its plane; no stretch along the normal."""
    mesh, rng = flat(), np.random.default_rng(2)
    maps = [random_map(rng) for _ in range(4)]
    positions = [mesh.points @ G.T + b for G, b in maps]
    measures = ("deformation_gradient", "stretch", "directions")
    found = wc.analyze(positions, mesh, measures=measures, neighbourhood=neighbourhood, dtype=dtype, device=device)
    bound, N = rounding(mesh, positions, dtype), TILT[:, 2]
    for k, (G, _) in enumerate(maps):
        n = np.cross(G @ TILT[:, 0], G @ TILT[:, 1])
        F = G @ (np.eye(3) - np.outer(N, N)) + np.outer(n / np.linalg.norm(n), N)
        W, S, _ = np.linalg.svd(F)
        bounded(found["deformation_gradient"][k], F, 2.0 * bound)
        bounded(found["stretch"][k], S, 2.0 * bound)
        d = found["directions"][k].astype(np.float64)
        gap = -np.diff(S).max()
        bounded(gap * np.abs(np.einsum("eij,ji->ei", d, W)), gap, 4.0 * bound)
    assert not found.excluded


@pytest.mark.parametrize("neighbourhood", [None, "1-ring"])
def test_a_measure_alone_is_that_among_all(neighbourhood, device):
    """To the bit, for every measure that there is: each finds by itself what it follows from."""
    mesh, rng, names = flat(), np.random.default_rng(5), MEASURES["triangle" if neighbourhood is None else "vertex"]
    positions = [mesh.points @ G.T + b for G, b in (random_map(rng) for _ in range(2))]
    given = {"dt": 10.0, "neighbourhood": neighbourhood, "rates": "forward", "device": device}
    if neighbourhood is None:
        given |= {"directions": (1.0, 0.2, 0.1), "material": wc.StVKMembrane(stiffness=2.0)}
    together = wc.analyze(positions, mesh, measures="all", **given)
    for name in names:
        np.testing.assert_array_equal(wc.analyze(positions, mesh, measures=name, **given)[name], together[name], name)


@every_dtype
@pytest.mark.parametrize("neighbourhood", SETS)
def test_fits_of_any_motion(neighbourhood, dtype, device):
    """F of a least-squares solver, R and residual of another fit, and H, of a curved mesh whose vertices go anywhere."""
    mesh, rng = jittered(lift=hill), np.random.default_rng(3)
    G, b = random_map(rng)
    x = mesh.points @ G.T + b + 0.02 * rng.normal(size=mesh.points.shape)
    measures = ("deformation_gradient", "stretch", "rotation", "rotation_angle", "residual", "cross_covariance")
    found = wc.analyze([x], mesh, measures=measures, neighbourhood=neighbourhood, dtype=dtype, device=device)
    sets, bound = SETS[neighbourhood](mesh), rounding(mesh, [x], dtype)
    F, R, residual = fitted(mesh, x, sets)
    # Of one-sided sets Σppᵀ is worse conditioned by up to the square of length over width, and sets here are 4 as long as wide.
    bounded(found["deformation_gradient"][0], F, 16.0 * bound)
    bounded(found["stretch"][0], np.linalg.svd(F, compute_uv=False), 16.0 * bound)
    bounded(found["residual"][0], residual, bound)
    H = np.array([(mesh.points[s] - mesh.points[s].mean(axis=0)).T @ (x[s] - x[s].mean(axis=0)) for s in sets])
    scale = np.linalg.norm(H, axis=(1, 2))
    bounded(np.linalg.norm(found["cross_covariance"][0] - H, axis=(1, 2)) / scale, 0.0, bound)
    S = np.linalg.svd(H, compute_uv=False)
    gap = (S[:, 1] + np.sign(np.linalg.det(H)) * S[:, 2]) / S[:, 0]
    bounded(gap[:, None, None] * found["rotation"][0], gap[:, None, None] * R, 4.0 * bound)
    bounded(gap * found["rotation_angle"][0], gap * Rotation.from_matrix(R).magnitude(), 4.0 * bound)


# Closed forms


@every_dtype
@pytest.mark.parametrize("rate", METHODS)
@pytest.mark.parametrize(("before", "after"), [(0.1, 0.4), (0.5, 3.0), (-0.3, -1.0)])
def test_simple_shear(before, after, rate, dtype, device):
    """G = I + γ e₁e₂ᵀ: λ = √(1 + γ²/4) ± γ/2, atan(γ/2), D₁₂ = W₁₂ = γ̇/2, by every method, as L² = 0."""
    mesh, dt = flat(), 0.02
    e1, e2, N = TILT.T
    positions = [mesh.points @ (np.eye(3) + g * np.outer(e1, e2)).T for g in (before, after)]
    names = (*STATIC, *RATES, "length_ratio", "angle", "length_rate", "angle_rate")
    found = wc.analyze(positions, mesh, dt=dt, measures=names, rates=rate, directions=e1, dtype=dtype, device=device)
    bound = rounding(mesh, positions, dtype) * (1.0 + abs(after)) ** 2
    lines = []
    for k, g in enumerate((before, after)):
        root, half = np.sqrt(1.0 + g * g / 4.0), abs(g) / 2.0
        bounded(found["stretch"][k], (root + half, root - half), bound)
        bounded(found["rotation_angle"][k], np.arctan(half), bound)
        bounded(found["area_ratio"][k], 1.0, bound)
        bounded(found["length_ratio"][k], (1.0, np.hypot(1.0, g)), bound)
        bounded(found["angle"][k], np.arctan2(1.0, g), bound)
        lines.append(0.5 * np.arctan2(2.0 * g, g * g))  # of the first direction from e₁: tan 2φ = 2/γ; at rest π/2 − φ
        along = np.cos(lines[-1]) * e1 + np.sin(lines[-1]) * e2
        # Of stretches that differ by γ.
        bounded(np.abs(found["directions"][k][:, 0] @ along), 1.0, bound / abs(g))
        across = np.sin(lines[-1]) * e1 + np.cos(lines[-1]) * e2
        bounded(np.abs(found["rest_directions"][k][:, 0] @ across), 1.0, bound / abs(g))
    speed, bound = (after - before) / dt, bound / dt
    bounded(found["velocity_gradient"][1], speed * np.outer(e1, e2), bound)
    bounded(found["rate_of_strain"][1], 0.5 * speed * (np.outer(e1, e2) + np.outer(e2, e1)), bound)
    bounded(found["spin"][1], 0.5 * speed * (np.outer(e1, e2) - np.outer(e2, e1)), bound)
    turning = (lines[1] - lines[0]) / dt
    bounded(found["direction_rate"][1], turning * N, 4.0 * bound / abs(before))
    bounded(found["rest_direction_rate"][1], -turning, 4.0 * bound / abs(before))
    bounded(found["angle_rate"][1], (np.arctan2(1.0, after) - np.arctan2(1.0, before)) / dt, bound)
    both = [np.array([np.hypot(1.0, g / 2) + abs(g) / 2, np.hypot(1.0, g / 2) - abs(g) / 2]) for g in (before, after)]
    bounded(found["stretch_rate"][1], of_numbers(*both, rate) / dt, 4.0 * bound)
    bounded(found["length_rate"][1, :, 1], of_numbers(np.hypot(1.0, before), np.hypot(1.0, after), rate) / dt, 4.0 * bound)


def of_numbers(a, b, method):
    """Δt ẏ/y of a number that goes from a to b."""
    return {"midpoint": 2.0 * (b - a) / (b + a), "forward": (b - a) / a, "logarithm": np.log(b / a)}[method]


@every_dtype
@pytest.mark.parametrize("rate", METHODS)
@on_both
def test_uniaxial_stretch(neighbourhood, rate, dtype, device):
    """G = diag(s, s^−½): λ, and D = diag(ṡ/s, −½ ṡ/s); the logarithm knows ṡ/s of s = exp(εt) exactly."""
    mesh, dt, speed = flat(), 0.1, 3.0
    values = np.exp(speed * dt * np.arange(1, 4))
    positions = [mesh.points @ (TILT @ np.diag([s, s**-0.5, 1.0]) @ TILT.T).T for s in values]
    given = {"neighbourhood": neighbourhood, "rates": rate, "dtype": dtype, "device": device}
    found = wc.analyze(positions, mesh, dt=dt, measures=("stretch", "rotation_angle", *RATES), **given)
    bound = rounding(mesh, positions, dtype) * values[-1]
    for k, s in enumerate(values):
        wanted = (s, s**-0.5) if neighbourhood is None else (s, 1.0, s**-0.5)
        bounded(found["stretch"][k], wanted, bound)
        if neighbourhood is None:  # the best rotation of an irregular set is not that in F
            bounded(found["rotation_angle"][k], 0.0, bound)
        if k:
            own = of_numbers(np.array([1.0, 1.0]), np.exp(speed * dt * np.array([1.0, -0.5])), rate) / dt
            bounded(found["stretch_rate"][k], own, 8.0 * bound / dt)
            D = TILT @ np.diag([*own, 0.0]) @ TILT.T
            bounded(found["rate_of_strain"][k], D, 8.0 * bound / dt)
            bounded(found["velocity_gradient"][k], D, 8.0 * bound / dt)
            for name in ("spin", "direction_rate", "rest_direction_rate"):
                bounded(found[name][k], 0.0, 8.0 * bound / dt)
    if rate == "logarithm":
        assert np.allclose(own, (speed, -0.5 * speed))


@every_dtype
def test_a_sheet_rolled_to_a_cylinder(dtype, device):
    """x = (sin κX/κ, (1 − cos κX)/κ, Z) of right triangles with sides h along X and Z.

    A side along X becomes a chord, 2 sin(κh/2)/κ long and turned by κ times X of its middle, exactly. Rings, which take
    sin κX/κ at X = 0 and ±h alone, stretch by sin(κh)/κh, and turn by κX where Σppᵀ is diagonal.
    """
    n, dt = 13, 0.25
    mesh = wc.Mesh.grid(n, n, size=1.0, pattern="alternating")
    X, _, Z = mesh.points.T
    h, bends = 1.0 / (n - 1), np.array([0.5, 1.0, 3.0])
    positions = [np.stack([np.sin(k * X) / k, (1.0 - np.cos(k * X)) / k, Z], axis=1) for k in bends]
    given = {"dt": dt, "rates": "logarithm", "dtype": dtype, "device": device}
    names = ("stretch", "rotation_angle", "stretch_rate")
    found = wc.analyze(
        positions, mesh, measures=(*names, "area_ratio", "green_strain", "length_ratio"), directions=(1, 0, 0), **given
    )
    bound, chords = rounding(mesh, positions, dtype), np.sin(bends * h / 2.0) / (bends * h / 2.0)
    sides = X[mesh.triangles]
    middle = 0.5 * (sides.min(axis=1) + sides.max(axis=1))
    for k, chord in enumerate(chords):
        bounded(found["stretch"][k], (1.0, chord), bound)
        bounded(found["rotation_angle"][k], bends[k] * middle, 4.0 * bound)
        bounded(found["area_ratio"][k], chord, bound)
        bounded(found["length_ratio"][k], (chord, 1.0), bound)
        bounded(np.linalg.norm(found["green_strain"][k], axis=(1, 2)), 0.5 * (1.0 - chord**2), bound)
        if k:
            bounded(found["stretch_rate"][k], (0.0, np.log(chord / chords[k - 1]) / dt), 2.0 * bound / dt)
    names = (*names, "directions", "rotation")
    found = wc.analyze(positions, mesh, measures=names, neighbourhood="1-ring", **given)
    inner = np.setdiff1d(np.arange(n * n), mesh.boundary)
    slopes = np.sin(bends * h) / (bends * h)
    for k, slope in enumerate(slopes):
        bounded(found["stretch"][k][inner], (1.0, 1.0, slope), 4.0 * bound)
        bounded(found["rotation_angle"][k][inner], bends[k] * X[inner], 16.0 * bound)
        bounded(found["rotation"][k][inner], [turn((0, 0, 1), a) for a in bends[k] * X[inner]], 16.0 * bound)
        if k:
            bounded(found["stretch_rate"][k][inner], (0.0, np.log(slope / slopes[k - 1]) / dt), 8.0 * bound / dt)


# Another observer, another reference


TURNED = {  # how each measure follows x → Qx
    "alone": ("stretch", "right_stretch", "right_cauchy_green", "green_strain", "area_ratio", "length_ratio", "angle",
              "energy_density", "stretch_rate", "rest_direction_rate", "length_rate", "angle_rate", "residual"),
    "QA": ("deformation_gradient", "rotation", "first_piola_stress", "direction_rate"),
    "AQᵀ": ("directions", "cross_covariance"),
    "QAQᵀ": ("velocity_gradient", "rate_of_strain", "spin", "cauchy_stress"),
}  # fmt: skip


@every_dtype
@pytest.mark.parametrize("rate", METHODS)
@on_both
def test_objectivity(neighbourhood, rate, dtype, device):
    """What a turned observer sees: stretches, energy and their rates are the same, L, D, W and σ turn with him."""
    mesh, Q, dt = jittered(lift=hill), turn((1.0, -3.0, 2.0), 2.0), 0.1
    positions = [drifting(mesh, t) for t in (0.3, 0.3 + dt)]
    given = {"dt": dt, "rates": rate, "neighbourhood": neighbourhood, "dtype": dtype, "device": device, "measures": "all"}
    if neighbourhood is None:
        given |= {"directions": (1.0, 0.3, 0.2), "material": wc.NeoHookeanMembrane(stiffness=1.0, poisson_ratio=0.3)}
    found, turned_found = (wc.analyze([x @ A.T for x in positions], mesh, **given) for A in (np.eye(3), Q))
    # On this motion λ₂ > 0.4 and λ₁ − λ₂ > 0.02 λ₁; the fits of one-sided rings are worse by up to 16.
    bound, gap = 16.0 * rounding(mesh, positions, dtype) / 0.4, 0.02
    low = found["stretch"][:, :, 1 if neighbourhood is None else 2].min()
    assert low > 0.4
    seen = set()
    for way, names in TURNED.items():
        for name in set(names) & set(found):
            a, b = (np.asarray(one[name][1], dtype=np.float64) for one in (found, turned_found))
            if name == "directions":
                a, b = (d[:, :, :, None] * d[:, :, None, :] for d in (a, b))
                a = Q @ a @ Q.T
            elif way == "QA":
                a = a @ Q.T if a.ndim == 2 else Q @ a
            elif way == "AQᵀ":
                a = a @ Q.T
            elif way == "QAQᵀ":
                a = Q @ a @ Q.T
            scale = np.abs(a).max() / (gap if "direction" in name else 1.0)
            seen.add(name)
            if name == "rotation" and neighbourhood is not None:
                scale = 8.0  # the second and third values of H together are not small beside the first
            bounded(b, a, scale * bound / (dt if found.measures[name].rate else 1.0))
    left = set(found) - seen
    assert left == {"rotation_angle", "rest_directions"} & set(found), left
    if neighbourhood is None:
        a, b = (one["rest_directions"][1].astype(np.float64) for one in (found, turned_found))
        bounded(b[:, :, :, None] * b[:, :, None, :], a[:, :, :, None] * a[:, :, None, :], bound / gap)


@every_dtype
@pytest.mark.parametrize("rate", METHODS)
def test_the_reference_does_not_matter_to_the_velocity_gradient(rate, dtype, device):
    """L = ḞF⁻¹ of two frames, whatever F is measured from."""
    mesh, dt = jittered(lift=hill), 0.1
    positions = [drifting(mesh, t) for t in (0.3, 0.3 + dt, 0.3 + 2 * dt)]
    other = wc.Mesh(drifting(mesh, 0.6), mesh.triangles)
    names = ("velocity_gradient", "rate_of_strain", "spin")
    given = {"dt": dt, "measures": names, "rates": rate, "dtype": dtype, "device": device}
    found = [
        wc.analyze(positions, mesh, **given),
        wc.analyze(positions, other, **given),
        wc.analyze(positions, mesh, reference="first", **given),
        wc.analyze(positions, mesh, reference="previous", **given),
    ]
    # L is at most 4 here and F₁ − F₀ is known to ε|x| over the altitude of either reference.
    bound = 2.0 * max(rounding(one, positions, dtype) for one in (mesh, other)) / dt
    for name in names:
        for one in found[1:]:
            bounded(one[name][-1], found[0][name][-1], bound)


# What measures would be by other means


RECORDED = {  # corners of one triangle of a cloth that was filmed, to the six digits of its files
    "rest": [[0.759919, -0.015194, 6.38401], [0.767822, -0.0212492, 6.3669], [0.726977, -0.00749985, 6.38692]],
    "moved": [[0.771842, -0.0144887, 6.39045], [0.780121, -0.0186188, 6.37318], [0.737177, -0.00912791, 6.39292]],
}


def test_a_recorded_triangle(device):
    """It stretches by 5 % and narrows by 1 %; F of the x and y of its sides alone says 32 % narrower.

    Its normal is far from z, so that those are no gradient of anything.
    """
    rest, moved = (np.array(corners) for corners in RECORDED.values())
    sides, moved_sides = rest[0] - rest[1:], moved[0] - moved[1:]
    assert np.array_equal(sides.round(4), [[-0.0079, 0.0061, 0.0171], [0.0329, -0.0077, -0.0029]])
    assert np.array_equal(moved_sides.round(4), [[-0.0083, 0.0041, 0.0173], [0.0347, -0.0054, -0.0025]])
    planar = moved_sides[:, :2].T @ np.linalg.inv(sides[:, :2].T)
    assert np.linalg.svd(planar, compute_uv=False).round(4).tolist() == [1.0544, 0.6757]
    mesh = wc.Mesh(rest, [[0, 1, 2]])
    found = wc.analyze([moved], mesh, measures=STATIC, device=device)
    assert found["stretch"][0, 0].round(4).tolist() == [1.0507, 0.9896]
    # What is written is exact: F maps the sides of the rest shape, and det C is the square of the ratio of areas.
    F = found["deformation_gradient"][0, 0] @ frames(mesh)[0, :, :2].T
    bound = rounding(mesh, [moved], "float64")
    bounded(F @ sides.T / np.abs(sides).max(), moved_sides.T / np.abs(sides).max(), 4.0 * bound)
    areas = [np.linalg.norm(np.cross(*pair)) for pair in (sides, moved_sides)]
    bounded(found["area_ratio"][0, 0], areas[1] / areas[0], 4.0 * bound)
    bounded(np.linalg.det(found["right_cauchy_green"][0, 0]), (areas[1] / areas[0]) ** 2, 8.0 * bound)


@every_dtype
def test_stretches_by_singular_and_by_eigenvalues(dtype, device):
    """Roots of C's eigenvalues are wrong by ελ₁²/λ₂, and NaN or noise of √ε λ₁ below; singular values are right."""
    rng, eps = np.random.default_rng(4), EPS[dtype]
    count = 2000
    U, V = rng.normal(size=(2, count, 3, 3))
    U, V = np.linalg.qr(U)[0][:, :, :2], np.linalg.qr(V[:, :2, :2])[0]
    ratio = 10.0 ** rng.uniform(-10.0, 0.0, count)
    F = (U * np.stack([np.ones(count), ratio], axis=1)[:, None, :]) @ V.mT
    mesh, x = separate(F)
    found = wc.analyze([x], mesh, measures=("stretch", "right_cauchy_green"), dtype=dtype, device=device)
    bounded(found["stretch"][0], np.stack([np.ones(count), ratio], axis=1), 8.0 * eps)
    with np.errstate(invalid="ignore"):
        roots = np.sqrt(np.linalg.eigvalsh(found["right_cauchy_green"][0])[:, ::-1])
    well = ratio > np.sqrt(64.0 * eps)
    assert well.mean() > 0.2
    assert (np.abs(roots - found["stretch"][0])[well, 1] <= 16.0 * eps / ratio[well]).all()
    lost, noise = np.isnan(roots[~well]).mean(), np.nanmax(np.abs(roots - found["stretch"][0]))
    print(f"{dtype}: of λ₂ < {np.sqrt(64.0 * eps):.0e} λ₁ eigenvalues give NaN for {lost:.0%}, and errors up to {noise:.1e} λ₁")
    assert lost > 0.05 and noise > 0.1 * np.sqrt(eps)
    # Of rank 1, in whole numbers, so that nothing is rounded on the way.
    u, v = rng.integers(1, 50, (count, 3)) * rng.choice([-1, 1], (count, 3)), rng.integers(1, 50, (count, 2))
    mesh, x = separate((u[:, :, None] * v[:, None, :]).astype(float))
    found = wc.analyze([x], mesh, measures=("stretch", "area_ratio"), dtype=dtype, device=device)
    first = np.linalg.norm(u, axis=1) * np.linalg.norm(v, axis=1)
    assert np.isfinite(found["stretch"]).all() and not found.excluded
    bounded(found["stretch"][0, :, 0] / first, 1.0, 8.0 * eps)
    bounded(found["stretch"][0, :, 1] / first, 0.0, 8.0 * eps)
    assert (found["stretch"] >= 0.0).all() and (found["area_ratio"][0] <= 8.0 * eps * first**2).all()


@every_dtype
def test_the_cross_covariance_is_no_gradient(dtype, device):
    """H = Σ p qᵀ = Σppᵀ Fᵀ: of a rigid turn its singular values are those of the set's shape [m²], where those of F are 1.

    Inner rings of eight of a grid with sides a and b: Σppᵀ = 6 diag(a², b²).
    """
    for size, scale in (((1.0, 1.0), 1.0), ((2.0, 1.0), 1.0), ((2.0, 1.0), 10.0)):
        n = 9
        mesh = wc.Mesh.grid(n, n, size=tuple(scale * s for s in size), pattern="alternating")
        positions = [mesh.points @ (turn((1, 2, 3), 1.0) @ np.diag([s, 1.0, 1.0])).T for s in (1.0, 1.5)]
        names = ("cross_covariance", "stretch", "deformation_gradient")
        found = wc.analyze(positions, mesh, measures=names, neighbourhood="1-ring", dtype=dtype, device=device)
        eight = [i for i, ring in enumerate(rings(mesh)) if len(ring) == 9]
        assert len(eight) == 25
        bound, (a, b) = rounding(mesh, positions, dtype), (scale * s / (n - 1) for s in size)
        for k, stretch in enumerate((1.0, 1.5)):
            H = found["cross_covariance"][k][eight].astype(np.float64)
            bounded(np.linalg.svd(H, compute_uv=False) / (6.0 * a * a), (stretch, (b / a) ** 2, 0.0), 4.0 * bound)
            bounded(found["stretch"][k], (stretch, 1.0, 1.0), 4.0 * bound)
            S = np.diag([6.0 * a * a, 1.0, 6.0 * b * b])
            P = np.diag([1.0, 0.0, 1.0])
            bounded(H.mT @ np.linalg.inv(S), found["deformation_gradient"][k][eight].astype(np.float64) @ P, 8.0 * bound)


@every_dtype
def test_the_best_rotation_of_a_set_is_not_that_in_its_gradient(dtype, device):
    """A pure stretch aslant to a ring with Σppᵀ = diag(s₁, s₂) turns it by atan(G₁₂(s₁ − s₂)/(G₁₁s₁ + G₂₂s₂)) at best."""
    mesh = wc.Mesh.grid(9, 9, size=(2.0, 1.0), pattern="alternating")
    G = np.array([[1.3, 0.0, 0.4], [0.0, 1.0, 0.0], [0.4, 0.0, 0.9]])
    positions = [mesh.points @ G.T]
    names = ("rotation_angle", "deformation_gradient")
    found = wc.analyze(positions, mesh, measures=names, neighbourhood="1-ring", dtype=dtype, device=device)
    inner = np.setdiff1d(np.arange(81), mesh.boundary)
    bound = rounding(mesh, positions, dtype)
    bounded(found["rotation_angle"][0][inner], np.arctan(0.4 * (4.0 - 1.0) / (1.3 * 4.0 + 0.9 * 1.0)), 4.0 * bound)
    bounded(found["deformation_gradient"][0], G, 4.0 * bound)
