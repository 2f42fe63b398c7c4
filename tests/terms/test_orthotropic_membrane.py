"""Membranes along warp and weft: strips cut off the axes, the picture frame, directions, refusals."""

import numpy as np
import pytest

import warpcloth as wc
from support.energies import FEW, energy_and_gradient, eps
from support.meshes import irregular
from support.steps import after_steps, newton_step

E1, E2, G, RATIO = 1000.0, 2500.0, 150.0, 0.25  # N/m
MODULI = {"warp": E1, "weft": E2, "shear": G, "poisson_ratio": RATIO}
# Strains over stresses along warp and weft, (E₁₁, E₂₂, 2E₁₂).
COMPLIANCE = np.array([[1.0 / E1, -RATIO / E1, 0.0], [-RATIO / E1, 1.0 / E2, 0.0], [0.0, 0.0, 1.0 / G]])


def energy_and_force(mesh, term, x, device):
    """At positions x, of a scene of the term alone."""
    return energy_and_gradient(wc.Scene(mesh, density=1.0, terms=[term]).build(device=device, dtype="float64"), x)


def stretches(mesh, x):
    """F (T, 3, 2) in the axes x and −z of a flat mesh, which are counter-clockwise from its front."""
    sides = [np.stack([p[mesh.triangles[:, i]] - p[mesh.triangles[:, 0]] for i in (1, 2)], axis=-1) for p in (mesh.points, x)]
    return sides[1] @ np.linalg.inv(sides[0][:, [0, 2]] * [[1.0], [-1.0]])


@pytest.mark.parametrize("degrees", [0.0, 10.0, 20.0, 30.0, 45.0, 60.0, 70.0, 80.0, 90.0])
def test_an_off_axis_strip_has_the_modulus_of_its_angle(degrees, device):
    """1/E(θ) = c⁴/E₁ + s⁴/E₂ + (1/G − 2ν₁₂/E₁)s²c². A line load f stretches it by λ, ½λ(λ² − 1)E(θ) = f; it shears too."""
    mesh, theta, pull = irregular(5, 5), np.radians(degrees), 0.1 * E1
    ends = [np.flatnonzero(np.abs(mesh.points[:, 0] - at) < 1e-9) for at in (0.0, 1.0)]
    loads = [wc.Traction(vertices=end, traction=(way * pull, 0.0, 0.0)) for end, way in zip(ends, (-1, 1), strict=True)]
    # The strip lies along x; its warp is turned clockwise from there.
    membrane = wc.OrthotropicMembrane.from_moduli(**MODULI, direction=(1.0, 0.0, 0.0), warp_angle=-theta)
    scene = wc.Scene(mesh, density=0.1, terms=[membrane], loads=loads, pins=[0], gravity=(0.0, 0.0, 0.0))
    F = stretches(mesh, wc.equilibrium(scene, device=device, tolerance=1e-9).points)
    E = 0.5 * (F.transpose(0, 2, 1) @ F - np.eye(2))
    c, s = np.cos(theta), np.sin(theta)
    modulus = 1.0 / (c**4 / E1 + s**4 / E2 + (1.0 / G - 2.0 * RATIO / E1) * s**2 * c**2)
    stretch = np.linalg.norm(F[:, :, 0], axis=1)
    assert 0.5 * stretch * (stretch**2 - 1.0) * modulus == pytest.approx(pull, rel=1e-6)
    # All of the strain, from a stress along the strip alone.
    along = np.array([c, s])  # by warp and weft
    stress = COMPLIANCE @ [c * c, s * s, c * s] * (2.0 * E[:, 0, 0] * modulus)[:, None] / 2.0
    across = np.array([-s, c])
    expected = [[stress[:, 0], 0.5 * stress[:, 2]], [0.5 * stress[:, 2], stress[:, 1]]]
    assert np.einsum("i,j,ijt->t", across, across, expected) == pytest.approx(E[:, 1, 1], abs=1e-6 * np.abs(E).max())
    assert np.einsum("i,j,ijt->t", along, across, expected) == pytest.approx(E[:, 0, 1], abs=1e-6 * np.abs(E).max())
    assert degrees in (0.0, 90.0) or np.abs(E[:, 0, 1]).min() > 1e-3, "it shears"


def test_a_picture_frame_measures_the_shear_modulus(device):
    """Sides a along warp and weft keep their lengths: the frame pulls by aG sin γ cos γ/sin(π/4 − γ/2) at its corners."""
    mesh, gamma, a = irregular(6, 6), 0.4, 1.0
    membrane = wc.OrthotropicMembrane.from_moduli(**MODULI, direction=(1.0, 0.0, 0.0))

    def sheared(angle):
        half = 0.5 * angle
        frame = np.array([[np.cos(half), 0.0, np.sin(half)], [0.0, 0.0, 0.0], [np.sin(half), 0.0, np.cos(half)]])
        return mesh.points @ frame.T

    energy, force = energy_and_force(mesh, membrane, sheared(gamma), device)
    assert energy[0] == pytest.approx(0.5 * G * a**2 * np.sin(gamma) ** 2, rel=1e3 * eps("float64"))
    moves = (sheared(gamma + 1e-5) - sheared(gamma - 1e-5)) / 2e-5  # by the angle
    longer = -2.0 * a * 0.5 * np.sin(0.5 * gamma - np.pi / 4.0)  # of the diagonal 2a cos(π/4 − γ/2), by the angle
    pull = (force * moves).sum() / longer
    assert pull == pytest.approx(a * G * np.sin(gamma) * np.cos(gamma) / np.sin(np.pi / 4.0 - gamma / 2.0), rel=1e-9)


def test_biaxial_tension_has_the_stress_of_both_moduli(device):
    """P = FS on each side of a sheet, shared by its vertices, to rounding."""
    mesh, F = irregular(6, 6), np.array([1.1, 0.97])
    membrane = wc.OrthotropicMembrane.from_moduli(**MODULI, direction=(1.0, 0.0, 0.0))
    _, force = energy_and_force(mesh, membrane, mesh.points * [F[0], 1.0, F[1]], device)
    S = np.linalg.inv(COMPLIANCE)[:2, :2] @ (0.5 * (F**2 - 1.0))
    for axis, at in ((0, 0), (2, 1)):
        side = np.abs(mesh.points[:, axis] - 1.0) < 1e-9
        assert force[side, axis].sum() == pytest.approx(F[at] * S[at], rel=1e4 * eps("float64"))


def test_equal_moduli_are_an_isotropic_membrane(device):
    mesh = irregular(6, 6)
    x = mesh.points + np.random.default_rng(2).normal(scale=0.05, size=mesh.points.shape)
    orthotropic = wc.OrthotropicMembrane(stiffness=30.0, poisson_ratio=0.3, warp=(1.0, 0.0, 0.4))
    energy, force = energy_and_force(mesh, wc.StVKMembrane(stiffness=30.0, poisson_ratio=0.3), x, device)
    found = energy_and_force(mesh, orthotropic, x, device)
    assert found[0] == pytest.approx(energy, rel=1e3 * eps("float64"))
    assert found[1] == pytest.approx(force, abs=1e3 * eps("float64") * np.abs(force).max())


def test_directions_by_texture_vector_and_angle_agree(device):
    """s grows along x in a grid: the vector x, and the vector z turned by 90° clockwise, seen from y, are the same."""
    mesh = wc.Mesh.grid(5, 4, pattern="alternating")
    x = mesh.points + np.random.default_rng(2).normal(scale=0.05, size=mesh.points.shape)
    each = np.tile([1.0, 5.0, 0.0], (len(mesh.triangles), 1))  # of which only the part in the plane counts
    quarter = 0.5 * np.pi
    for given in (
        {"warp": (1.0, 0.0, 0.0)},
        {"warp": each},
        {"warp": (0.0, 0.0, -1.0), "warp_angle": -quarter},
        {"warp_angle": np.full(len(mesh.triangles), np.pi)},
    ):
        for kind, more in ((wc.OrthotropicMembrane, {"shear_ratio": 0.1}), (wc.PlateBending, {"twist_ratio": 0.1})):
            terms = [kind(stiffness=1.0, weft_ratio=3.0, **more, **each) for each in ({}, given, {"warp_angle": 0.5})]
            energies = [energy_and_force(mesh, term, x, device)[0][0] for term in terms]
            assert energies[1] == pytest.approx(energies[0], rel=1e4 * FEW * eps("float64"))
            assert abs(energies[2] / energies[0] - 1.0) > 1e-3


@pytest.mark.parametrize(
    "solver", [wc.ADMM(substeps=1, tolerance=1e-11, iterations=4000), wc.Newton(substeps=1, tolerance=1e-11)]
)
def test_solvers_that_minimise_meet(solver, device):
    mesh = wc.Mesh.grid(6, 5, pattern="alternating")
    start = mesh.points + np.random.default_rng(3).normal(scale=0.02, size=mesh.points.shape)
    membrane = wc.OrthotropicMembrane.from_moduli(warp=50.0, weft=120.0, shear=10.0, poisson_ratio=0.3)
    scene = wc.Scene(mesh, density=0.1, terms=[membrane], positions=start, pins=[0])
    exact = newton_step(scene, device)
    assert np.abs(after_steps(scene, solver, device)[0] - exact).max() < 1e-8


def test_stress_of_an_animation_is_that_of_its_directions(device):
    """S = Cε, of a strain along the warp of an orthotropic membrane."""
    mesh, membrane = wc.Mesh.grid(4, 4), wc.OrthotropicMembrane.from_moduli(**MODULI)
    found = wc.analyze([mesh.points, mesh.points * [1.01, 1.0, 1.0]], mesh=mesh, material=membrane, measures=["energy_density"])
    strain = 0.5 * (1.01**2 - 1.0)
    expected = 0.5 * E1 / (1.0 - RATIO**2 * E2 / E1) * strain**2
    assert np.asarray(found["energy_density"])[-1] == pytest.approx(expected, rel=1e-4)


bare = wc.Mesh([[0.0, 0, 0], [1.0, 0, 0], [0, 0, 1.0]], [[0, 2, 1]])
of = wc.OrthotropicMembrane.from_moduli


@pytest.mark.parametrize(
    ("declare", "sentence"),
    [
        (lambda: of(1.0, 4.0, 1.0, 0.5), "OrthotropicMembrane.poisson_ratio is 0.5; it must have a square below 1/weft_ratio"),
        (lambda: of([4.0, 1.0], [1.0, 4.0], [1.0, 1.0], 0.7), r"poisson_ratio\[1\] is 0.7.* not positive definite"),
        (lambda: of(1.0, -1.0, 1.0), "OrthotropicMembrane.weft is -1.0; it must be finite and above 0"),
        (lambda: of(1.0, 1.0, 0.0), "OrthotropicMembrane.shear is 0.0; it must be finite and above 0"),
        (lambda: of(1.0, 1.0, np.nan), "OrthotropicMembrane.shear is nan; it must be finite and above 0"),
        (lambda: of(1.0, 1.0, 1.0).elements(bare, bare.points), "OrthotropicMembrane.warp is None on a mesh without texture"),
        (lambda: of(1.0, 1.0, 1.0, direction=(0, 1, 0)).elements(bare, None), "warp has no direction in triangle 0"),
        (lambda: of(1.0, 1.0, 1.0, warp_angle=np.inf), "OrthotropicMembrane.warp_angle is inf; it must be finite"),
    ],
)
def test_refusals(declare, sentence):
    with pytest.raises(ValueError, match=sentence):
        declare()
