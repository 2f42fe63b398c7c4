"""Measured fabrics: energies from records, what is refused, scenes and stages that name one."""

from dataclasses import replace

import numpy as np
import pytest

import warpcloth as wc
from support.command_line import run
from warpcloth.usd import read_scene, write_scene

MESH = wc.Mesh.grid(4, 4, pattern="alternating")
WHOLE = [name for name, fabric in wc.fabrics.items() if fabric.poisson_ratio is not None and fabric.shear is not None]
needs_a_number = [name for name in wc.fabrics if name not in WHOLE]


@pytest.mark.parametrize("name", WHOLE)
def test_terms_have_the_moduli_of_the_record(name):
    """D = E t³/12(1 − ν₁₂ν₂₁), D₆₆ = G t³/12; bending lengths of cloth, from 1 to 5 cm."""
    fabric = wc.fabrics[name]
    membrane, bending = fabric.terms(warp_angle=0.3)
    t, whole = fabric.thickness, 1.0 - fabric.poisson_ratio**2 * fabric.weft / fabric.warp
    assert membrane.stiffness == fabric.warp and membrane.weft_ratio * membrane.stiffness == pytest.approx(fabric.weft)
    assert membrane.shear_ratio * membrane.stiffness == pytest.approx(fabric.shear)
    assert bending.stiffness == pytest.approx(fabric.warp * t**2 / 12.0 / whole)
    assert bending.stiffness * bending.weft_ratio == pytest.approx(fabric.weft * t**2 / 12.0 / whole)
    assert bending.stiffness * bending.twist_ratio == pytest.approx(fabric.shear * t**2 / 12.0)
    assert bending.poisson_ratio**2 == pytest.approx(1.0 - whole)
    assert membrane.warp_angle == bending.warp_angle == 0.3
    assert all(0.01 < length < 0.05 for length in fabric.bending_lengths)
    for term in (membrane, bending):
        term.elements(MESH, MESH.points)
    x, _, z = MESH.points.T
    cylinder = bending.operator(MESH) @ (0.5 * (x * np.cos(0.5) + z * np.sin(0.5)) ** 2)  # at 0.5 + 0.3 rad to the warp
    energy = bending.stiffness * (cylinder.reshape(-1, 3) ** 2).sum(axis=1)
    assert energy == pytest.approx(np.full(len(energy), fabric.bending_along(0.8)))


@pytest.mark.parametrize("name", needs_a_number)
def test_a_fabric_without_a_number_is_refused_by_its_name(name):
    fabric = wc.fabrics[name]
    missing = "poisson_ratio" if fabric.poisson_ratio is None else "shear"
    with pytest.raises(ValueError, match=f"fabric '{name}' has no {missing}, which a membrane needs"):
        wc.Scene(MESH, fabric=name)
    if fabric.bending_warp is None:
        with pytest.raises(ValueError, match="has no bending_warp, which bending needs"):
            fabric.bending()
    else:
        assert wc.Scene(MESH, fabric=replace(fabric, poisson_ratio=0.1)).density == fabric.density


def test_every_record_says_where_it_is_from():
    assert all(fabric.source and fabric.notes and name == fabric.name for name, fabric in wc.fabrics.items())


def test_a_scene_takes_density_and_terms_from_it(device):
    scene = wc.Scene(MESH, fabric="denim", pins=[0], duration=0.1)
    assert scene.density == 0.4 and [term.label for term in scene.terms] == ["OrthotropicMembrane", "PlateBending"]
    assert replace(scene, duration=0.2).density == 0.4  # once made it is a scene like others
    assert wc.simulate(scene, wc.Newton(substeps=2), device=device).status.ok


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ({"density": 0.1}, "fabric and density are given"),
        ({"masses": np.ones(16)}, "fabric and masses are given"),
        ({"terms": [wc.Spring(stiffness=1.0)]}, "fabric and terms are given"),
        ({"fabric": "denin"}, "fabric is 'denin'; it must be one of cotton, wool"),
        ({"fabric": 3}, "fabric is 3; it must be a Fabric or its name"),
    ],
)
def test_refusals_of_scenes(given, sentence):
    with pytest.raises(ValueError, match=sentence):
        wc.Scene(MESH, **{"fabric": "denim", **given})


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ({"density": 0.0}, "Fabric.density is 0"),
        ({"density": 0.1, "shear": np.nan}, "Fabric.shear is nan"),
        ({"density": None}, "Fabric.density is None"),
        ({"density": 0.1, "source": 3}, "Fabric.source is 3; it must be a text"),
    ],
)
def test_refusals_of_records(given, sentence):
    with pytest.raises(ValueError, match=sentence):
        wc.Fabric(name="felt", **given)


STAGE = """#usda 1.0
(
    defaultPrim = "Cloth"
    metersPerUnit = 1
    upAxis = "Y"
)

def Mesh "Cloth"
{
    int[] faceVertexCounts = [3, 3]
    int[] faceVertexIndices = [0, 2, 1, 1, 2, 3]
    point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 0, 1), (1, 0, 1)]
    texCoord2f[] primvars:st = [(0, 0), (0, 1), (-1, 0), (-1, 1)] (
        interpolation = "vertex"
    )
    token warpcloth:fabric = "silk"
    DENSITY
}
"""


def test_a_stage_names_one(tmp_path):
    """In place of a density and terms; what is written has those. Its warp, along which s grows, is −z."""
    path = tmp_path / "silk.usda"
    path.write_text(STAGE.replace("DENSITY", ""))
    scene = read_scene(path)
    assert scene.density == 0.083 and scene.terms[0].stiffness == 327.0
    assert np.allclose(scene.terms[0].warp_directions(scene.mesh), [0.0, 0.0, -1.0])
    write_scene(scene, tmp_path / "written.usda")
    again = read_scene(tmp_path / "written.usda")
    assert again.density == 0.083 and [term.stiffness for term in again.terms] == [term.stiffness for term in scene.terms]
    path.write_text(STAGE.replace("DENSITY", "double warpcloth:density = 0.1"))
    with pytest.raises(ValueError, match="fabric and density are given"):
        read_scene(path)


def test_the_command_lists_them(capfd):
    code, out, _ = run(capfd, "fabrics")
    assert code == 0 and all(name in out for name in wc.fabrics) and "1673" in out and "Clyde" in out
