"""Rates of deforming surfaces: rigid turns, constant velocity gradients, and the order of each method."""

from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm, tanhm

import warpcloth as wc
from support.continuum import (
    TILT,
    bounded,
    constant,
    corner_normals,
    drifting,
    every_dtype,
    flat,
    frames,
    hill,
    jittered,
    normals,
    on_both,
    outer,
    rates,
    rounding,
    skew,
    strains,
    symmetric,
    thread_rates,
    tumbling,
    turn,
)

AXES = {"e₁": TILT[:, 0], "N": TILT[:, 2], "any": np.array([0.3, -0.5, 0.8]), "another": np.array([-1.0, 0.1, 0.2])}


@every_dtype
@pytest.mark.parametrize("mesh", [flat(), jittered(lift=hill)], ids=["flat", "curved"])
@on_both
@pytest.mark.parametrize("axis", AXES)
def test_turning(axis, neighbourhood, mesh, dtype, device):
    """30° a frame about any axis: D = 0 by midpoint and logarithm, W = 2 tan(ωΔt/2)/Δt and ω; forward a spurious D."""
    dt, angle = 0.04, np.radians(30.0)
    a = AXES[axis] / np.linalg.norm(AXES[axis])
    positions = [mesh.points @ turn(a, k * angle).T + k * np.array([0.1, -0.2, 0.3]) for k in range(7)]
    bound, given = rounding(mesh, positions, dtype), {"neighbourhood": neighbourhood, "dtype": dtype, "device": device}
    names = ("stretch", "stretch_rate", "rotation_angle", "rate_of_strain", "spin")
    for method, size in (("midpoint", 2.0 * np.tan(angle / 2.0)), ("logarithm", angle), ("forward", np.sin(angle))):
        found = wc.analyze(positions, mesh, dt=dt, measures=names, rates=method, **given)
        bounded(found["stretch"], 1.0, bound)
        bounded(found["stretch_rate"][1:] * dt, 0.0, 2.0 * bound)
        bounded(found["rotation_angle"], (angle * np.arange(7))[:, None], bound)
        bounded(found["spin"][1:] * dt, size * skew(a), 2.0 * bound)
        wanted = 0.0
        if method == "forward":
            wanted = np.cos(angle) - 1.0
            wanted *= np.array([in_plane(mesh, x, np.eye(3) - np.outer(a, a), neighbourhood) for x in positions[:-1]])
            if np.ptp(mesh.points @ a) < 1e-12:  # the mesh turns in its plane
                spurious = np.linalg.eigvalsh(found["rate_of_strain"][1:] * dt)
                bounded(spurious, (np.cos(angle) - 1.0, np.cos(angle) - 1.0, 0.0), 2.0 * bound)
        bounded(np.linalg.norm(found["rate_of_strain"][1:] * dt - wanted, axis=(2, 3)), 0.0, bound)


def in_plane(mesh, x, A, neighbourhood):
    """P A P of each triangle or vertex, P the projection to its plane at x."""
    n = normals(x, mesh.triangles) if neighbourhood is None else corner_normals(mesh, x)
    P = np.eye(3) - outer(n, n)
    return P @ A @ P


CONSTANT = {
    "stretch": [[0.9, 0.0], [0.0, -0.5]],
    "shear": [[0.0, 1.2], [0.0, 0.0]],
    "spiral": [[0.3, -1.0], [1.0, 0.3]],
    "nearly half a turn": [[0.1, -2.6], [2.6, -0.2]],
    "no normal matrix": [[0.5, 1.5], [-0.2, -0.7]],
}


@every_dtype
@on_both
@pytest.mark.parametrize("name", CONSTANT)
def test_a_constant_velocity_gradient(name, neighbourhood, dtype, device):
    """x = exp(Lt)X: the logarithm gives L, midpoint (2/Δt) tanh(½LΔt), forward (exp(LΔt) − I)/Δt, in a plane."""
    mesh, dt, LDt = flat(), 0.2, np.zeros((3, 3))
    LDt[:2, :2] = CONSTANT[name]
    LDt = TILT @ LDt @ TILT.T
    motion = constant(LDt / dt)
    positions = [motion(mesh.points, k * dt) for k in range(3)]
    # The step F₁F₀⁻¹ is known to its condition, and tanh and log have slopes of up to 1/(1 + cos) near half a turn.
    step = expm(LDt)
    near_half = 2.0 / abs(np.linalg.eigvals(expm(LDt) + np.eye(3))).min()
    bound = 4.0 * rounding(mesh, positions, dtype) * np.linalg.cond(step) * np.linalg.norm(step, 2) ** 2 * near_half**2
    given = {"neighbourhood": neighbourhood, "dtype": dtype, "device": device}
    wanted = {"logarithm": LDt, "midpoint": 2.0 * tanhm(0.5 * LDt), "forward": step - np.eye(3)}
    for method, L in wanted.items():
        found = wc.analyze(
            positions, mesh, dt=dt, measures=("velocity_gradient", "rate_of_strain", "spin"), rates=method, **given
        )
        bounded(found["velocity_gradient"][1:] * dt, L, bound)
        bounded(found["rate_of_strain"][1:] * dt, 0.5 * (L + L.T), bound)
        bounded(found["spin"][1:] * dt, 0.5 * (L - L.T), bound)


def turned_rate(method, axis, angle, before, normal):
    """Computes DΔt, in the tangent plane, of a small strain (3, 3) given before the turn, as docs/measuring.md says."""
    half, k = turn(axis, angle / 2.0), np.outer(axis, axis)
    E, across, n = half @ before @ half.T, np.eye(3) - k, half @ normal
    G = k + across / np.cos(angle / 2.0)
    if method == "forward":
        D, n = (np.cos(angle) - 1.0) * across + symmetric(half @ half @ before), normal
    elif method == "midpoint":
        D, n = G @ E @ G, G @ n
    else:
        mean = 0.5 * np.trace(across @ E) * across
        rest = across @ E @ across - mean
        shear = k @ E @ across + across @ E @ k
        D = k @ E @ k + mean + shear * (angle / 2.0) / np.sin(angle / 2.0) + rest * angle / np.sin(angle)
        n = G @ n
    P = np.eye(3) - np.outer(n, n) / (n @ n)
    return P @ D @ P


@on_both
@pytest.mark.parametrize("degrees", [10.0, 30.0, 90.0, 150.0, 170.0])
@pytest.mark.parametrize("axis", AXES)
def test_what_a_turn_does_to_the_rate_of_strain(axis, degrees, neighbourhood, device):
    """The law of small strains, dilation, stretch and shear, to their square; stretch rates are right at any angle."""
    mesh, size, angle = flat(), 1e-5, np.radians(degrees)
    a = AXES[axis] / np.linalg.norm(AXES[axis])
    for plane in ([[1.0, 0.0], [0.0, 1.0]], [[1.0, 0.0], [0.0, -0.6]], [[0.2, 0.5], [0.5, -0.3]]):
        E = np.zeros((3, 3))
        E[:2, :2] = plane
        E = size * TILT @ E @ TILT.T
        positions = [mesh.points, mesh.points @ (turn(a, angle) @ expm(E)).T]
        for method in ("midpoint", "logarithm", "forward"):
            given = {"rates": method, "neighbourhood": neighbourhood, "device": device}
            found = wc.analyze(positions, mesh, dt=1.0, measures=("rate_of_strain", "stretch_rate"), **given)
            steep = 1.0 / np.cos(angle / 2.0) ** 4  # second derivatives in E
            bounded(
                found["rate_of_strain"][1], turned_rate(method, a, angle, E, TILT[:, 2]), 4.0 * steep * size**2 + 1e-12 * steep
            )
            stretches = np.sort(np.linalg.eigvalsh(plane))[::-1] * size
            bounded(found["stretch_rate"][1], stretches, size**2 + 1e-12)


TURNS = ("N", "N", "e₁", "e₁", "45°")  # axes of the columns of the table in docs/measuring.md


@pytest.mark.parametrize("degrees", [10, 30, 90, 150])
def test_what_a_turn_does_to_a_dilation(degrees, device):
    """Checks the table, and for a turn about the normal the closed form for any dilation."""
    text = (Path(__file__).parents[2] / "docs" / "measuring.md").read_text(encoding="utf-8")
    (row,) = (line.split("|")[2:-1] for line in text.splitlines() if line.startswith(f"| {degrees}° |"))
    mesh, angle, e = flat(), np.radians(degrees), 0.2
    largest = []
    for name, method in zip(TURNS, ("midpoint", "logarithm", "midpoint", "logarithm", "logarithm"), strict=True):
        axis = TILT[:, 0] + TILT[:, 2] if name == "45°" else AXES[name]
        positions = [mesh.points, np.exp(e) * mesh.points @ turn(axis, angle).T]
        found = wc.analyze(positions, mesh, dt=1.0, measures=("rate_of_strain",), rates=method, device=device)
        largest.append(np.linalg.eigvalsh(found["rate_of_strain"][1]).max() / e)
    assert [float(cell) for cell in row] == pytest.approx(largest, abs=6e-4)
    assert largest[:2] == pytest.approx([2.0 * np.sinh(e) / (np.cosh(e) + np.cos(angle)) / e, 1.0], rel=1e-9)


@on_both
@pytest.mark.parametrize("rate", ["midpoint", "logarithm"])
def test_half_a_turn_is_undefined(rate, neighbourhood, device):
    """It has no sense of rotation: NaN, and a sentence, never a number."""
    mesh = flat()
    for axis in AXES.values():
        positions = [mesh.points, mesh.points @ turn(axis, np.pi).T + 1.0]
        given = {"neighbourhood": neighbourhood, "rates": rate, "device": device}
        found = wc.analyze(positions, mesh, dt=1.0, measures=("velocity_gradient", "rate_of_strain", "spin"), **given)
        for name in found:
            assert np.isnan(found[name][1]).all()
        assert any("180°" in str(exclusion) for exclusion in found.excluded)


ORDERS = {"midpoint": 2, "logarithm": 2, "forward": 1}


@pytest.mark.parametrize("method", ORDERS)
@on_both
def test_rates_converge(neighbourhood, method, device):
    """A motion that tumbles and stretches: L, D, W, and rates of stretches, directions, lengths and angles at mid-step.

    Midpoint and logarithm are of second order there, forward of first; angles are differences, of second order in each.
    """
    mesh = jittered(lift=hill) if neighbourhood is None else flat()
    motion, middle, T = tumbling(), 0.4, frames(mesh)
    F, rate = motion.G(middle) @ T[:, :, :2], motion.rate(middle) @ T[:, :, :2]
    wanted, threads = rates(F, rate), {}
    gap = -np.diff(strains(F)["stretch"], axis=1)
    assert gap.min() > 0.1, "directions are defined"
    if neighbourhood is None:
        threads = {"directions": (1.0, 0.3, 0.2)}
        first = np.array(threads["directions"]) @ T[:, :, :2]
        first = first / np.linalg.norm(first, axis=1, keepdims=True)
        second = np.stack([-first[:, 1], first[:, 0]], axis=1)
        wanted["length_rate"], wanted["angle_rate"] = thread_rates(F, rate, np.stack([first, second], axis=2))[2:]
    else:  # a plane: all alike
        wanted = {name: values[0] for name, values in wanted.items()}
    errors = {name: [] for name in wanted}
    for dt in (0.02, 0.01, 0.005):
        positions = [motion(mesh.points, middle + s * dt / 2.0) for s in (-1.0, 1.0)]
        found = wc.analyze(
            positions, mesh, dt=dt, measures=tuple(wanted), rates=method, neighbourhood=neighbourhood, device=device, **threads
        )
        for name, values in wanted.items():
            difference = np.reshape(found[name][1] - values, (len(found[name][1]), -1))
            errors[name].append(np.sqrt((difference**2).sum(axis=1).mean()))
    for name, error in errors.items():
        order = 2 if name in ("direction_rate", "rest_direction_rate", "angle_rate") else ORDERS[method]
        size = np.linalg.norm(wanted[name]) / np.sqrt(len(mesh.triangles) if neighbourhood is None else 1.0)
        print(f"{method} {name}: {error} of {size:.2f}")
        assert error[-1] < 0.02 * size
        assert np.log2(error[-2] / error[-1]) == pytest.approx(order, abs=0.1), name


@pytest.mark.parametrize("method", ["midpoint", "logarithm"])
@on_both
def test_a_spinning_observer(neighbourhood, method, device):
    """x → Q(t)x with Q̇ = [ω]Q: D turns with Q and W gains [ω], in second order at mid-step; stretch rates do not change."""
    mesh, w, middle = jittered(lift=hill), np.array([2.0, -1.0, 1.5]), 0.3
    names, errors = ("rate_of_strain", "spin", "stretch_rate"), []
    Q = expm(skew(w) * middle)
    for dt in (0.02, 0.01, 0.005):
        given = {"dt": dt, "measures": names, "rates": method, "neighbourhood": neighbourhood, "device": device}
        times = middle - dt / 2.0, middle + dt / 2.0
        still = wc.analyze([drifting(mesh, t) for t in times], mesh, **given)
        seen = wc.analyze([drifting(mesh, t) @ expm(skew(w) * t).T for t in times], mesh, **given)
        apart = seen["rate_of_strain"][1] - Q @ still["rate_of_strain"][1] @ Q.T
        spin = seen["spin"][1] - Q @ still["spin"][1] @ Q.T - skew(w)
        errors.append([np.abs(apart).max(), np.abs(spin).max()])
        bounded(
            seen["stretch_rate"][1], still["stretch_rate"][1], 8.0 * rounding(mesh, [drifting(mesh, middle)], "float64") / dt
        )
    assert max(errors[-1]) < 0.02 * np.linalg.norm(w)
    assert np.abs(np.log2(np.divide(errors[-2], errors[-1])) - 2.0).max() < 0.1
