"""Readings of the devices of textile laboratories, against the moduli of the fabric and closed forms."""

import json
from dataclasses import replace

import numpy as np
import pytest

import warpcloth as wc
from support.command_line import run
from support.rows import slow_but
from support.scenes import scene
from warpcloth.lab import elastica
from warpcloth.lab.laboratory import check_sample, drape_coefficient, recorded
from warpcloth.run.equilibrium import Equilibrium
from warpcloth.scene.measured_fabrics import DRAPES

COTTON = wc.fabrics["cotton"]


def read(declared, device, **options):
    """Values by their names, at rest."""
    rest = wc.equilibrium(declared, device=device, record="reactions", **options)
    assert rest.status.ok and rest.stable, rest.status
    return {quantity: value for quantity, (value, _unit) in wc.laboratory_readings(declared, rest).items()}


@pytest.mark.parametrize("degrees", np.linspace(0.0, 90.0, 9))
def test_a_strip_off_the_axes_has_its_modulus(degrees, device):
    """To 1e-6 at a strain of 1e-7; the grips let it shear, so it is stretched uniformly."""
    E1, E2, G, ratio = COTTON.warp, COTTON.weft, COTTON.shear, COTTON.poisson_ratio
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    # A tension along the strip is c² along the warp, s² along the weft and a shear of sc.
    strain = np.array([[1.0 / E1, -ratio / E1, 0.0], [-ratio / E1, 1.0 / E2, 0.0], [0.0, 0.0, 1.0 / G]]) @ [c * c, s * s, s * c]
    expected = 1.0 / (strain @ [c * c, s * s, s * c])
    found = read(scene("strip", angle=degrees, strain=1e-7, elements=4), device, tolerance=1e-10)
    assert found["modulus"] == pytest.approx(expected, rel=1e-6)
    assert COTTON.modulus_along(np.radians(degrees)) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("degrees", [1.0, 40.0])
def test_a_picture_frame_reads_the_shear_modulus(degrees, device):
    found = read(scene("picture_frame", angle=degrees, n=4), device, tolerance=1e-13)
    g = np.radians(degrees)
    expected = 0.2 * COTTON.shear * np.sin(g) * np.cos(g) / np.sin(np.pi / 4.0 - g / 2.0)
    assert found["force along the diagonal"] == pytest.approx(expected, rel=1e-10)
    assert found["shear modulus"] == pytest.approx(COTTON.shear, rel=1e-10)


# Fabrics of which D(θ) is that of narrow strips too, as they do not curl across: ν = 0, or 0 in the axes at 45°.
THICK = 3e-4
ALIGNED = wc.Fabric(
    name="aligned",
    density=0.2,
    warp=2e3,
    weft=5e3,
    shear=300.0,
    poisson_ratio=0.0,
    thickness=THICK,
    bending_warp=15e-6,
    bending_weft=40e-6,
)
ALIKE = replace(
    ALIGNED, weft=2e3, shear=0.75 * 20e-6 * 12.0 / THICK**2, poisson_ratio=0.5, bending_warp=20e-6, bending_weft=20e-6
)
STRIPS = {"warp": (ALIGNED, 0.0, 15e-6), "weft": (ALIGNED, 90.0, 40e-6), "45°": (ALIKE, 45.0, 30e-6)}


@pytest.mark.parametrize("strip", slow_but(["45°"], STRIPS))
def test_a_shirley_tester_reads_twice_the_bending_length(strip, device):
    """The overhang to 0.2 %; the exact elastica of L = 2c hangs at 41.49°."""
    fabric, angle, D = STRIPS[strip]
    c = (D / (fabric.density * 9.81)) ** (1 / 3)
    found = read(scene("cantilever", gamma=8.0, fabric=fabric, angle=angle, elements=24, width=8.0 * c / 24), device)
    assert found["overhang at 41.5°"] == pytest.approx(2e3 * c, rel=2e-3)
    assert found["bending length"] == pytest.approx(1e3 * c, rel=2e-3)
    assert found["D"] == pytest.approx(1e6 * D, rel=6e-3)
    assert found["angle of the tip"] == pytest.approx(41.49, abs=0.1)


@pytest.mark.parametrize(
    ("bending", "width", "stiffness", "tolerance"), [("plate", 0.3, 1.0, 1.5e-2), ("quadratic", 0.0, 8.0 / 9.0, 2e-3)]
)
def test_a_shirley_tester_reads_strips_of_no_fabric(bending, width, stiffness, tolerance, device):
    """Of 12 elements; a row of triangles has 8/9 of D. The clamp of a plate is 0.18 elements behind its pins."""
    found = read(scene("cantilever", gamma=8.0, elements=12, bending=bending, width=width), device)
    assert found["bending length"] == pytest.approx(500.0 * stiffness ** (1 / 3), rel=tolerance)


@pytest.mark.host
@pytest.mark.parametrize("strip", slow_but(["warp"], STRIPS))
def test_a_heart_loop_reads_the_bending_length(strip, device):
    """To 1 %, a quarter of that with twice the elements: the depth of the loop changes by 0.2 % if D changes by 1 %."""
    fabric, angle, D = STRIPS[strip]
    c, elements = (D / (fabric.density * 9.81)) ** (1 / 3), 48
    width = 4.0 * 100.0 ** (1 / 3) * c / elements
    found = read(scene("loop", fabric=fabric, angle=angle, elements=elements, width=width), device)
    assert found["bending length"] == pytest.approx(1e3 * c, rel=1e-2)


@pytest.mark.parametrize(
    ("kind", "gamma", "depth"),
    [
        ("pear", 0.0, 0.424308),
        ("ring", 0.0, 0.318310),
        ("heart", 0.0, 0.133860),
        ("heart", 10.0, 0.139540),
        ("heart", 100.0, 0.184043),
    ],
)
def test_depths_of_loops(kind, gamma, depth):
    assert elastica.loop_depth(kind, gamma) == pytest.approx(depth, rel=1e-5)


@pytest.mark.parametrize(("height", "folds"), [(0.0, 0), (1e-3, 5)])
def test_folds_of_an_outline(height, folds):
    """Rounding errors of a flat outline are no folds."""
    declared = scene("cusick", rows=4)
    x, _, z = declared.mesh.points.T
    points = declared.mesh.points * (1.0 + height * np.cos(5.0 * np.arctan2(z, x)))[:, None]
    rest = Equilibrium(points, None, 0)
    assert wc.laboratory_readings(declared, rest)["folds"] == (folds, "")


@pytest.mark.parametrize("degrees", [60.0, 150.0])
def test_the_shadow_of_a_cone(degrees):
    """A ring turned down by α ends at R₁ + (R₂ − R₁) cos α; what is below the support has no shadow of its own."""
    mesh = scene("cusick", rows=8).mesh
    radius = np.hypot(*mesh.points[:, [0, 2]].T)
    over = np.maximum(radius - 0.09, 0.0)
    turned = np.minimum(radius, 0.09) + over * np.cos(np.radians(degrees))
    cone = mesh.points * (turned / radius)[:, None] - np.outer(over * np.sin(np.radians(degrees)), [0.0, 1.0, 0.0])
    outer = max(0.09 + 0.06 * np.cos(np.radians(degrees)), 0.09)
    found = drape_coefficient(cone, mesh.points, mesh.triangles)
    assert found == pytest.approx((outer**2 - 0.09**2) / (0.15**2 - 0.09**2), abs=1e-3)


def test_a_stiff_disc_sinks_like_a_plate(device):
    """An annular plate with a clamped inner and a free outer circle: w = A + B ln r + C r² + E r² ln r + qr⁴/64D to 1 %.

    The clamp is 0.18 rows inside the second row of pins, as for a strip.
    """
    rows, D, ratio, outer = 8, 1.0, 0.3, 0.15
    modulus = {"warp": 2e3, "weft": 2e3, "shear": 1e3 / (1.0 + ratio), "poisson_ratio": ratio}
    stiff = wc.Fabric(name="stiff", density=0.2, **modulus, bending_warp=D, bending_weft=D)
    rest = wc.equilibrium(scene("cusick", fabric=stiff, rows=rows), device=device)
    assert rest.status.ok and rest.stable, rest.status
    inner = 0.09 * (1.0 - 0.18 * (1.0 - (0.09 / 0.15) ** (1.0 / rows)))
    q, log = 0.2 * 9.81 / D, np.log(outer)
    equations = [
        [1.0, np.log(inner), inner**2, inner**2 * np.log(inner)],  # w = 0
        [0.0, 1.0 / inner, 2.0 * inner, inner * (2.0 * np.log(inner) + 1.0)],  # w′ = 0
        [0.0, (ratio - 1.0) / outer**2, 2.0 + 2.0 * ratio, 2.0 * log + 3.0 + ratio * (2.0 * log + 1.0)],  # w″ + νw′/r = 0
        [0.0, 0.0, 0.0, 4.0 / outer],  # (Δw)′ = 0
    ]
    loads = [q * inner**4 / 64, q * inner**3 / 16, q * outer**2 * (3.0 + ratio) / 16, q * outer / 2]
    constants = np.linalg.solve(equations, -np.array(loads))
    expected = constants @ [1.0, log, outer**2, outer**2 * log] + q * outer**4 / 64
    assert -rest.points[:, 1].min() == pytest.approx(expected, rel=1e-2)


def test_a_listed_drape_is_computed(device):
    """All eight starts of canvas read 90.9 % with rows=8; with rows=4 there are several shapes of rest, from 89.9 to 91.7 %."""
    assert read(scene("cusick", fabric="canvas", rows=8), device)["drape coefficient"] == pytest.approx(
        DRAPES["canvas"], abs=0.05
    )


def test_what_has_no_reading_is_refused(device):
    strip, hanging = scene("strip", elements=2), scene("cantilever", gamma=0.01, fabric=ALIGNED, elements=6, width=0.005)
    frame = scene("picture_frame", n=3)
    for declared, record, sentence in (
        (strip, (), "rest has no reactions, which the device measures"),
        (hanging, (), "the tip hangs .*° below the clamp; its Γ must be from 0.4 to 100, best 8"),
        (scene("loop", kind="pear", elements=8), (), "deep, and without weight it would be 0.4243; take more elements or a"),
        (replace(frame, pins=frame.mesh.boundary), "reactions", "the shear modulus of the scene .* is .*; a reading must be"),
    ):
        rest = wc.equilibrium(declared, device=device, record=record)
        with pytest.raises(ValueError, match=sentence):
            wc.laboratory_readings(declared, rest)


def test_what_is_no_sample_is_refused():
    free = scene("hanging", n=4)
    for declared, sentence in (
        (free, "scene.name is 'hanging'; it must be one of 'cantilever', 'loop'"),
        (replace(free, name="cantilever"), "'cantilever' is not the sample of its device; it must be a strip along x, pinned"),
        (replace(free, name="strip"), "'strip' is not the sample of its device; it must be a strip along x, pinned at its"),
        (replace(free, name="loop", pins=[]), "'loop' is not the sample of its device"),
        (scene("loop", gamma=0.0), "the scene 'loop' has no gravity, which its device needs; its gamma must be above 0"),
        (replace(free, name="picture_frame"), "'picture_frame' is not the sample of its device; it must be a square with a"),
        (replace(free, name="cusick"), "'cusick' is not the sample of its device; it must be a disc of radius 0.15 m"),
    ):
        with pytest.raises(ValueError, match=sentence):
            check_sample(declared)


@pytest.mark.parametrize(
    ("device", "angle", "values", "why"),
    [
        ("strip", 0.0, {"modulus": COTTON.warp}, "finite strain"),
        ("picture_frame", 0.0, {"shear modulus": COTTON.shear}, "tolerance"),
        ("cusick", 0.0, {"drape coefficient": DRAPES["cotton"]}, "the mean of eight starts"),
        ("cantilever", np.pi / 2, {"bending length": 1e3 * COTTON.bending_lengths[1], "D": 1e6 * COTTON.bending_weft}, "width"),
        (
            "loop",
            0.0,
            {"bending length": 1e3 * COTTON.bending_lengths[0], "D": 1e6 * COTTON.bending_warp},
            "computed, as E·t³/12(1 − ν₁₂ν₂₁)",
        ),
    ],
)
def test_the_record_stands_beside_the_reading(device, angle, values, why):
    found, reason = recorded(device, COTTON, angle)
    assert found == pytest.approx(values) and why in reason
    assert "computed from" not in recorded(device, replace(COTTON, computed=()), angle)[1]


def test_the_command_prints_the_reading(capfd, tmp_path):
    shape = tmp_path / "strip.npz"
    code, out, _ = run(capfd, "measure", "strip", "-p", "angle=0", "elements=2", "strain=1e-6", "--json", "-o", str(shape))
    found = json.loads(out)["readings"]["modulus"]
    assert code == 0 and found["unit"] == "N/m" and found["value"] == pytest.approx(COTTON.warp, rel=1e-5)
    assert len(wc.open_sequence(str(shape))) == 1
    for given in (["strip", "-p", "elements=2", "strain=1e-6"], ["picture_frame", "--fabric", "denim"]):
        code, out, _ = run(capfd, "measure", *given)
        assert code == 0 and "(record of the fabric: " in out and "they differ" not in out
        assert "--fabric" not in given or "1616 N/m" in out
    code, out, _ = run(capfd, "measure", "strip", "-p", "elements=2")
    assert code == 0 and "modulus  " in out and f"(record of the fabric: {COTTON.modulus_along(np.pi / 4):.4g})" in out
    assert "they differ because the reading is at a finite strain" in out
    for given, sentence in (
        (["hanging"], "hanging is no test of a laboratory; it must be one of cantilever"),
        (["strip", "-o", "strip.obj"], "--output is strip.obj; it must end with .npz"),
        (["strip", "-o", str(tmp_path / "none" / "a.npz")], "none does not exist"),
        (["strip", "-p", "fabric=denim-wang"], "fabric 'denim-wang' has no poisson_ratio"),
        (["picture_frame", "-p", "angle=90"], "angle is 90; it must be below 90, at which the frame is shut"),
        (["cantilever", "-p", "fabric=silk", "width=1e-4"], "width is 0.0001 m, below 4 elements of"),
        (["loop", "-p", "fabric=silk", "width=1e-4"], "; take more elements or a wider strip"),
        (["cantilever", "-p", "fabric=silk", "gamma=-1"], "gamma is -1.0; it must be a number above 0"),
        (["picture_frame", "-p", "n=2"], "n is 2; it must be a whole number of 3 or more"),
        (["cantilever", "-p", "elements=0"], "elements is 0; it must be a whole number of 2 or more"),
        (["strip", "-p", "length=0"], "length is 0.0; it must be a number above 0"),
        (["picture_frame", "-p", "angle=90"], "angle is 90; it must be below 90, at which the frame is shut"),
    ):
        code, _, error = run(capfd, "measure", *given)
        assert code == 2 and sentence in error
