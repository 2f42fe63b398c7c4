"""Energy and stress of deforming membranes: derivatives, linear moduli, tension, and what holds of Cauchy's stress."""

import numpy as np
import pytest

import warpcloth as wc
from support.continuum import (
    EPS,
    bounded,
    every_dtype,
    flat,
    frames,
    hill,
    jittered,
    neo_hookean,
    random_map,
    rounding,
    separate,
    turn,
)
from support.energies import DENSITIES, material_of

STIFFNESS = 40.0
NAMES = ("energy_density", "first_piola_stress", "cauchy_stress")


def material(name="NeoHookeanMembrane", ratio=0.3):
    """A membrane, and its μ and λ [N/m]."""
    given, mu, lam = material_of(name, ratio)
    return wc.terms.TERMS[name](stiffness=STIFFNESS, **given), STIFFNESS * mu, STIFFNESS * lam


def gradients_of(rng, count):
    """Random F (E, 3, 2) with stretches in [0.3, 2]."""
    return np.stack([random_map(rng)[0][:, :2] for _ in range(count)])


@every_dtype
@pytest.mark.parametrize("ratio", [0.0, 0.3, 0.49, -0.3])
@pytest.mark.parametrize("mesh", [flat(), jittered(lift=hill)], ids=["flat", "curved"])
def test_neo_hookean(mesh, ratio, dtype, device):
    """u(λ₁, λ₂), P = W diag(∂u/∂λ) Vᵀ and σ = P Fᵀ/J, on any mesh."""
    rng, (membrane, mu, lam) = np.random.default_rng(5), material(ratio=ratio)
    for _ in range(4):
        G, b = random_map(rng)
        x = mesh.points @ G.T + b
        found = wc.analyze([x], mesh, measures=NAMES, material=membrane, dtype=dtype, device=device)
        F = G @ frames(mesh)[:, :, :2]
        u, P = neo_hookean(F, mu, lam)
        J = np.linalg.norm(np.cross(F[:, :, 0], F[:, :, 1]), axis=1)
        # ∂u and ∂²u are at most (2μ + λ)|F|³ where |F| ≤ 3.
        bound = rounding(mesh, [x], dtype) * (2.0 * mu + abs(lam)) * 27.0
        bounded(found["energy_density"][0], u, bound)
        bounded(found["first_piola_stress"][0], P, bound)
        bounded(found["cauchy_stress"][0], P @ F.mT / J[:, None, None], 4.0 * bound / J.min())


@pytest.mark.parametrize("name", DENSITIES)
def test_stress_is_the_derivative_of_the_energy(name, device):
    """P = ∂u/∂F by central differences of δ, wrong by δ²|∂³u| and by rounding of u over δ."""
    membrane, mu, lam = material(name)
    F, delta = gradients_of(np.random.default_rng(6), 50), 1e-5
    mesh, x = separate(F)
    shifts = delta * np.eye(6).reshape(6, 3, 2)
    positions = [x, *(separate(F + sign * shift)[1] for shift in shifts for sign in (1.0, -1.0))]
    found = wc.analyze(positions, mesh, measures=NAMES, material=membrane, device=device)
    u = found["energy_density"][1:].reshape(6, 2, len(F))
    wanted = (u[:, 0] - u[:, 1]).T.reshape(-1, 3, 2) / (2.0 * delta)
    scale = (2.0 * mu + lam) * 27.0
    # Of ‖F − R‖² the third derivative is that of R, 1/(λ₁ + λ₂)².
    bounded(found["first_piola_stress"][0], wanted, 20.0 * scale * (delta**2 + EPS["float64"] / delta))
    assert np.abs(wanted).max() > 0.1 * mu


@every_dtype
@pytest.mark.parametrize("ratio", [0.0, 0.3, 0.49, -0.3])
@pytest.mark.parametrize("name", DENSITIES)
def test_at_rest(name, ratio, dtype, device):
    """No energy and no stress, and P = 2με + λ tr(ε) I of a small strain ε, up to its square."""
    membrane, mu, lam = material(name, ratio)
    rng, small = np.random.default_rng(7), 1e-6 if dtype == "float64" else 1e-3
    strain = rng.normal(size=(20, 2, 2))
    strain = 0.5 * (strain + strain.mT)
    rest = np.broadcast_to(np.eye(3)[:, :2], (20, 3, 2))
    F = rest + small * np.pad(strain, ((0, 0), (0, 1), (0, 0)))
    mesh, x = separate(F)
    turned = turn((1.0, 2.0, 3.0), 1.0)
    found = wc.analyze(
        [mesh.points, mesh.points @ turned.T, x], mesh, measures=NAMES, material=membrane, dtype=dtype, device=device
    )
    size = 2.0 * mu + abs(lam)
    for k in (0, 1):
        for name in NAMES:
            bounded(found[name][k], 0.0, 16.0 * EPS[dtype] * size)
    trace = np.trace(strain, axis1=1, axis2=2)
    P = 2.0 * mu * strain + lam * trace[:, None, None] * np.eye(2)
    # ε here is up to 3, u's third derivatives a few of its second.
    bound = size * (50.0 * small**2 + 16.0 * EPS[dtype])
    bounded(found["first_piola_stress"][2][:, :2], small * P, bound)
    bounded(found["first_piola_stress"][2][:, 2], 0.0, bound)
    bounded(
        found["energy_density"][2],
        0.5 * small**2 * (P * strain).sum(axis=(1, 2)),
        bound * 9.0 * small + (16.0 * EPS[dtype]) ** 2,
    )


@every_dtype
@pytest.mark.parametrize("ratio", [0.0, 0.3, 0.49, -0.3])
def test_uniaxial_tension(ratio, dtype, device):
    """A strip stretched by a narrows by b = a(2μ + λ)/(μ + (λ + μ)a²), pulled by μ(a − b) + (λ + μ)(ab − 1)b, σ that over b."""
    membrane, mu, lam = material(ratio=ratio)
    a = np.array([0.6, 0.9, 1.0 + 1e-3, 1.5, 3.0])
    b = a * (2.0 * mu + lam) / (mu + (lam + mu) * a**2)
    F = np.zeros((len(a), 3, 2))
    F[:, 0, 0], F[:, 1, 1] = a, b
    mesh, x = separate(F)
    found = wc.analyze([x], mesh, measures=NAMES, material=membrane, dtype=dtype, device=device)
    pull = mu * (a - b) + (lam + mu) * (a * b - 1.0) * b
    P, sigma = np.zeros((len(a), 3, 2)), np.zeros((len(a), 3, 3))
    P[:, 0, 0], sigma[:, 0, 0] = pull, pull / b
    bound = 8.0 * EPS[dtype] * (2.0 * mu + abs(lam)) * 27.0
    bounded(found["first_piola_stress"][0], P, bound)
    bounded(found["cauchy_stress"][0], sigma, 4.0 * bound)
    # Young's modulus, and Poisson's ratio, of the small one: Et is the stiffness.
    assert pull[2] / 1e-3 == pytest.approx(STIFFNESS, rel=2e-3) and (1.0 - b[2]) / 1e-3 == pytest.approx(ratio, abs=4e-3)


@every_dtype
@pytest.mark.parametrize("name", DENSITIES)
def test_cauchy_stress(name, dtype, device):
    """σ = P Fᵀ/J, symmetric exactly, in the plane, of power σ:D J = P:Ḟ, and turned with the cloth."""
    membrane, mu, lam = material(name)
    rng = np.random.default_rng(8)
    F, Q = gradients_of(rng, 50), turn((1.0, -3.0, 2.0), 2.0)
    mesh, x = separate(F)
    found = wc.analyze(
        [x, x @ Q.T], mesh, measures=("deformation_gradient", *NAMES), material=membrane, dtype=dtype, device=device
    )
    P, sigma, turned = (found[name][k].astype(np.float64) for name, k in ((NAMES[1], 0), (NAMES[2], 0), (NAMES[2], 1)))
    normal = np.cross(F[:, :, 0], F[:, :, 1])
    J = np.linalg.norm(normal, axis=1)
    bound = 4.0 * EPS[dtype] * (2.0 * mu + lam) * 27.0 / J.min()
    assert np.array_equal(sigma, sigma.mT)
    bounded(sigma, P @ F.mT / J[:, None, None], bound)
    bounded(np.einsum("eij,ej->ei", sigma, normal / J[:, None]), 0.0, bound)
    bounded(turned, Q @ sigma @ Q.T, 4.0 * bound)
    rate = rng.normal(size=F.shape)
    n = np.cross(F[:, :, 0], F[:, :, 1])[:, :, None] / J[:, None, None]
    L = np.concatenate([rate, np.zeros_like(n)], axis=2) @ np.linalg.inv(np.concatenate([F, n], axis=2))
    power = J * np.einsum("eij,eij->e", sigma, 0.5 * (L + L.mT))
    bounded(power, np.einsum("eij,eij->e", P, rate), 4.0 * bound)
