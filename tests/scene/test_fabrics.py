"""Measured fabrics: energies from records, what is refused, scenes and stages that name one."""

from dataclasses import replace

import numpy as np
import pytest

import warpcloth as wc
from support.command_line import run
from support.mesh_texts import usda
from warpcloth.usd import read_scene, write_scene

MESH = wc.Mesh.grid(4, 4, pattern="alternating")
WHOLE = [name for name, fabric in wc.fabrics.items() if fabric.poisson_ratio is not None and fabric.shear is not None]
THIN = replace(wc.fabrics["denim-wang"], name="thin", poisson_ratio=0.2)
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
        assert "np.float" not in repr(term)  # as the scene prints it
    x, _, z = MESH.points.T
    cylinder = bending.operator(MESH) @ (0.5 * (x * np.cos(0.5) + z * np.sin(0.5)) ** 2)  # at 0.5 + 0.3 rad to the warp
    energy = bending.stiffness * (cylinder.reshape(-1, 3) ** 2).sum(axis=1)
    assert energy == pytest.approx(np.full(len(energy), fabric.bending_along(0.8)))


@pytest.mark.parametrize("name", needs_a_number)
def test_a_fabric_without_a_number_is_refused_by_its_name(name):
    fabric = wc.fabrics[name]
    missing = "poisson_ratio" if fabric.poisson_ratio is None else "shear"
    with pytest.raises(ValueError, match=f"fabric '{name}' has no {missing}, which a membrane needs; take another fabric"):
        wc.Scene(MESH, fabric=name)
    if fabric.bending_warp is None:
        with pytest.raises(ValueError, match="has no bending_warp, which bending needs"):
            fabric.bending()
    else:
        assert wc.Scene(MESH, fabric=replace(fabric, poisson_ratio=0.1)).density == fabric.density


def test_a_scene_takes_density_and_terms_from_it(device):
    scene = wc.Scene(MESH, fabric="denim", pins=[0], duration=0.1)
    assert scene.density == 0.4 and [term.label for term in scene.terms] == ["OrthotropicMembrane", "PlateBending"]
    assert replace(scene, duration=0.2).density == 0.4  # once made it is a scene like others
    assert wc.simulate(scene, wc.Newton(substeps=2), device=device, dtype="float64").status.ok


BALL = wc.Sphere(radius=0.1, position=(0.0, -1.0, 0.0))


@pytest.mark.parametrize(
    ("fabric", "given", "distances"),
    [
        ({"fabric": "denim"}, {}, (0.33e-3, 0.66e-3)),  # half of it between the middle of the cloth and a collider
        ({"fabric": "denim"}, {"distance": 2e-3}, (2e-3, 2e-3)),
        ({"density": 0.1, "terms": [wc.Spring(stiffness=1.0)]}, {}, (1e-3, 1e-3)),
    ],
    ids=["fabric", "given", "none"],
)
def test_a_fabric_gives_contact_its_thickness(fabric, given, distances):
    """And the stiffness follows from it, (2/r)(wL/r + Y/L)."""
    scene = wc.Scene(MESH, **fabric, contact=wc.Contact(**given), self_contact=wc.SelfContact(**given), colliders=[BALL])
    for contact, distance in zip((scene.contact, scene.self_contact), distances, strict=True):
        assert contact.distance == pytest.approx(distance)
        w, Y = scene.density * 9.81, scene.terms[0].held(MESH, MESH.points)[1].mean()  # of 1 m
        assert contact.stiffness == pytest.approx(2.0 / distance * (w / distance + Y))
    bare = wc.Scene(MESH, **fabric)
    if given:
        return
    assert wc.Scene(MESH, **fabric, colliders=[BALL]).contact.distance == pytest.approx(distances[0])  # not declared
    later = {"colliders": [BALL], "contact": wc.Contact(), "self_contact": wc.SelfContact()}
    for late in (replace(bare, **later), wc.Scene.join({"a": bare, "b": bare}, **later)):
        assert [late.contact.distance, late.self_contact.distance] == pytest.approx(distances)


def test_a_thickness_that_is_not_known_or_not_the_same_gives_no_distance():
    """Contact without a distance is refused where it acts, and colliders without contact have 1 mm."""
    denim, thin, free = (wc.Scene(MESH, fabric=fabric) for fabric in ("denim", THIN, "silk"))
    for unknown in (thin, wc.Scene.join({"a": denim, "b": free}), wc.Scene.join({"a": thin, "b": thin})):
        assert replace(unknown, contact=wc.Contact()).contact.distance is None  # without colliders it has no effect
        assert replace(unknown, colliders=[BALL]).contact.distance == 1e-3
        assert replace(unknown, self_contact=wc.SelfContact(distance=2e-3)).self_contact.distance == 2e-3
        assert replace(unknown, thickness=4e-4, self_contact=wc.SelfContact()).self_contact.distance == 4e-4
        with pytest.raises(ValueError, match=r"^self_contact has no distance, and the thickness of the cloth is not known"):
            replace(unknown, self_contact=wc.SelfContact())
        with pytest.raises(ValueError, match=r"^contact has no distance, and the thickness of the cloth is not known"):
            replace(unknown, contact=wc.Contact(), colliders=[BALL])
    joined = wc.Scene.join({"a": denim, "b": free}, thickness=5e-4, self_contact=wc.SelfContact())
    assert joined.self_contact.distance == 5e-4


REFUSED_SCENES = [
    ({"density": 0.1}, "fabric and density are given"),
    ({"masses": np.ones(16)}, "fabric and masses are given"),
    ({"terms": [wc.Spring(stiffness=1.0)]}, "fabric and terms are given"),
    ({"fabric": "denin"}, "fabric is 'denin'; it must be one of cotton, wool"),
    ({"fabric": 3}, "fabric is 3; it must be a Fabric or its name"),
    ({"thickness": 1e-3}, "fabric and thickness are given"),
    ({"fabric": None, "density": 0.1, "thickness": 0.0}, "thickness is 0.0; it must be"),
]
REFUSED_RECORDS = [
    ({"density": 0.0}, "Fabric.density is 0"),
    ({"density": 0.1, "shear": np.nan}, "Fabric.shear is nan"),
    ({"density": None}, "Fabric.density is None"),
    ({"density": 0.1, "source": 3}, "Fabric.source is 3; it must be a text"),
    ({"density": 0.1, "computed": ("bogus",)}, r"Fabric.computed is \('bogus',\); it must be a tuple of names of density"),
    ({"density": 0.1, "computed": ("name", [])}, r"Fabric.computed is \('name', \[\]\); it must be a tuple of names"),
    ({"density": 0.1, "computed": "shear"}, "Fabric.computed is 'shear'; it must be a tuple of names"),
]


@pytest.mark.parametrize(("given", "sentence"), [*REFUSED_SCENES, *REFUSED_RECORDS])
def test_refusals_of_scenes_and_records(given, sentence):
    with pytest.raises(ValueError, match=sentence):
        wc.Fabric(name="felt", **given) if "Fabric." in sentence else wc.Scene(MESH, **{"fabric": "denim", **given})


POINTS, FACES = [(0, 0, 0), (1, 0, 0), (0, 0, 1), (1, 0, 1)], [(0, 2, 1), (1, 2, 3)]
ST = 'texCoord2f[] primvars:st = [(0, 0), (0, 1), (-1, 0), (-1, 1)] (interpolation = "vertex")'
STAGE = usda(POINTS, FACES, f'{ST}\ntoken warpcloth:fabric = "silk"\nDENSITY')


def test_a_stage_names_one(tmp_path):
    """In place of a density and terms; what is written has those. Its warp, along which s grows, is −z."""
    path = tmp_path / "silk.usda"
    path.write_text(STAGE.replace("DENSITY", ""))
    scene = read_scene(path)
    assert scene.density == 0.083 and scene.thickness == wc.fabrics["silk"].thickness and scene.terms[0].stiffness == 327.0
    assert np.allclose(scene.terms[0].warp_directions(scene.mesh), [0.0, 0.0, -1.0])
    write_scene(scene, tmp_path / "written.usda")
    again = read_scene(tmp_path / "written.usda")
    assert again.thickness == scene.thickness
    assert again.density == 0.083 and [term.stiffness for term in again.terms] == [term.stiffness for term in scene.terms]
    path.write_text(STAGE.replace("DENSITY", "double warpcloth:selfContact:friction = 0.2"))
    assert read_scene(path).self_contact.distance == scene.thickness
    path.write_text(STAGE.replace("DENSITY", "double warpcloth:density = 0.1"))
    with pytest.raises(ValueError, match="fabric and density are given"):
        read_scene(path)


ARCSIM = """{ // a material
    "density": 0.2, "stretching": [[50, 10, 100, 30], [1, 2, 3, 4]], "note": "http://x",
    "bending": [[24e-6, 1], [1, 1], [16e-6, 1]]
}"""
KES = """name,W,T,B-1,B-2,G 1,G 2,EMT-1,WT-1,LT-1,EMT-2,LT-2,2HB-1
wool,20,0.6,0.1,0.05,0.7,0.9,4,8,,4,0.8,0.03
silk,8,,,,,,,,,,,
"""
FAST = """name,W,T2,C-warp,C-weft,EB5,E5-warp,E20-warp,E100-weft,ST
wool,200,0.5,20,18,2,0.5,1.25,2,0.1
felt,200,,,,,,,,
"""


def listed(fabric):
    names = ("density", "thickness", "warp", "weft", "shear", "poisson_ratio", "bending_warp", "bending_weft")
    return [getattr(fabric, name) for name in names]


@pytest.mark.parametrize(
    ("name", "text", "numbers"),
    [
        # k₁ = 100, k₁₂ = 20, k₂ = 200, 4Gt = 60 N/m: E = k − k₁₂²/k, ν₁₂ = k₁₂/k₂.
        ("wool.json", "\ufeff" + ARCSIM, [0.2, None, 98.0, 196.0, 15.0, 0.1, 6e-6, 4e-6]),
        # gf = 9.80665 mN, gf·cm = 98.0665 µN·m, G per degree, 2WT/EMT² with WT = 8 gf/cm, also from LT = 2WT/(EMT·500).
        (
            "lab.csv",
            KES,
            [0.2, 6e-4, *[2.0 * 8.0 * 0.980665 / 0.04**2] * 2, 0.8 * 0.980665 * 180.0 / np.pi, None, 9.80665e-6, 4.903325e-6],
        ),
        # 15 gf/cm over 0.75 %, 100 gf/cm over 2 %, 4.9 N/m over 4 times 2 %, W g c³.
        (
            "lab.csv",
            FAST,
            [0.2, 5e-4, 14.709975 / 0.0075, 98.0665 / 0.02, 4.903325 / 0.08, None, 1.962 * 8e-6, 1.962 * 5.832e-6],
        ),
    ],
    ids=["ARCSim", "KES-F", "FAST"],
)
def test_files_give_fabrics_in_si_units(name, text, numbers, tmp_path, capfd):
    """And what is not measured is missing, and refused by its name; what was derived is said."""
    (tmp_path / name).write_text(text)
    found = wc.read_fabrics(tmp_path / name)
    assert listed(found["wool"]) == pytest.approx(numbers)
    assert found["wool"].source == name and len(found["wool"].notes) > 100
    if numbers[5] is None:
        with pytest.raises(ValueError, match="fabric 'wool' has no poisson_ratio, which a membrane needs"):
            wc.Scene(MESH, fabric=found["wool"])
    else:
        assert wc.Scene(MESH, fabric=found["wool"]).terms[0].stiffness == pytest.approx(98.0)
    if "silk" in found:
        assert listed(found["silk"]) == pytest.approx([0.08, *[None] * 7])
    code, out, _ = run(capfd, "fabrics", str(tmp_path / name))
    assert code == 0 and "wool" in out and "denim" not in out
    if text == FAST:
        assert "[1] lab.csv" in out and "E₁t is from E20 − E5. E₂t is from E100. Columns that were ignored: ST." in out
        assert found["felt"].warp is None and "E₁t" not in found["felt"].notes and "felt   " in out and " [2]\n" in out
    else:
        assert ("Columns that were ignored: 2HB-1." in out) == (text == KES)


def test_a_material_of_the_published_code_is_its_record(tmp_path):
    """The first entries of that of gray interlock, from the tables of Wang, O'Brien and Ramamoorthi."""
    first = '{"density": 0.187, "stretching": [[16.59, -14.70, 34.48, 36.86]], "bending": [[23.2e-6], [24.7e-6], [14.3e-6]]}'
    (tmp_path / "interlock.json").write_text(first)
    found, record = wc.read_fabrics(tmp_path / "interlock.json")["interlock"], wc.fabrics["interlock-wang"]
    known = [k for k, value in enumerate(listed(record)) if value is not None]
    assert [listed(found)[k] for k in known] == pytest.approx([listed(record)[k] for k in known], rel=0.03)
    assert found.poisson_ratio == 0.0  # as k₁₂ is below 0


def arcsim(old, new):
    return ARCSIM.replace(old, new, 1)


LARGER = ", line 2: E20 of direction 1 is {}, E5 is {}; E20 must be larger by 0.005 or more"
REFUSED = {  # by ending: text, and what follows the name of the file
    "json": [
        ("{", ", line 1: Expecting property name"),
        ('{"density": 0.1, "stretching": [1, 2, 3, 4]}', ": has no bending; a material of ARCSim must"),
        (arcsim("100,", ""), r": stretching begins with \[50.0, 10.0, 30.0\]; it must be a row of 4 numbers"),
        (arcsim("[1, 1], ", ""), ": bending is .*; it must be rows of numbers"),
        (arcsim("0.2", "-1"), ": Fabric.density is -1"),
        ('{"note": "für"}', ": is no text in UTF-8, 'utf-8' codec can't decode byte 0xfc in position 11"),
        (arcsim("{", '{"density": 1, '), ": 'density' occurs twice in one JSON object; each name must"),
        (arcsim("{", '{"note": {"a": 1, "a": 1}, '), ": 'a' occurs twice in one JSON object"),
        (arcsim("0.2", "1" * 5001), ": Fabric.density is inf; it must be a number above 0, and finite"),
        (arcsim("100,", "1" * 400 + ","), r": stretching begins with \[50.0, 10.0, inf, 30.0\]; it must"),
        ("[" * 100_000, ": is nested too deeply; it must be a JSON object"),
        (arcsim("10, 100", "80, 20"), r".*begins with \[50.0, 80.0, 20.0, 30.0\], .*; k₁₂² must be below k₁k₂"),
        (arcsim("50, 10, 100", "1e200, 1e200, 1e200"), ": stretching begins .*; k₁₂² must be below k₁k₂"),
        (arcsim("50, 10, 100", "1e308, 1e160, 1e200"), ": Fabric.warp is inf; it must be a number above 0"),
        (arcsim("100, 30", "100, 0"), ".*the fourth number must be above 0"),
        (arcsim("24e-6", "-24e-6"), ".*bending begins with -2.4e-05 at 0° and 1.6e-05 at 90°; they must be"),
    ],
    "csv": [
        ("EMT,WT,LT\nwool,20,4,8,99", r", line 2: LT of direction 1 is 99, but 2WT/.* is 0.8; must"),
        ("\nwool,1", ": has no columns of either KES-F"),
        ("LT,E5\nwool,1,1,1", ": has columns of both KES-F"),
        ("LT\nwool,1,1\nwool,1,1", ", line 3: name is 'wool', as before; each fabric must have its own"),
        ("B1,B warp,LT\nwool,1,1,1,1", ": columns 'B1' and 'B warp' are the same number"),
        ("LT\nwool,,1", ", line 2: fabric 'wool' has no W, the weight"),
        ("LT\nwool,1,-1", ", line 2: LT is -1.0; it must be a number from 0.0001 to 1e"),
        ("E5,E20\nwool,1,2,1", LARGER.format("1.0", "2.0")),
        ("E5,E20\nwool,1,2,2", LARGER.format("2.0", "2.0")),
        ("E5,E20\nwool,1,1,1.0000000000000002", LARGER.format("1.0000000000000002", "1.0")),
        ("EMT,WT\nwool,1,0.001,8", ".*WT of direction 1 is 8; it must be at most 500 gf/cm·EMT, 0.005"),
    ],
    "txt": [("", ": is a .txt; it must be .json of ARCSim or .csv")],
}
OUTSIDE = ("EMT,WT 1e-300,10", "EMT,WT 5,inf", "WT,LT 1e-320,0.6", "EMT,LT 1e300,0.6", "E5,E20 1e-320,2e-320", "E100 nan")
for given in (*OUTSIDE, "E100,C 1,1e200", "LT,G1,G2 1,1e308,1e308"):
    row = given.replace(" ", "\nwool,1,")
    REFUSED["csv"].append((row, r", line 2: \w+ is \S+; it must be a number from 0.0001 to 1e"))
REFUSED["csv"] = [("name,W" + ("," * (text[0] != "\n")) + text + "\n", sentence) for text, sentence in REFUSED["csv"]]
REFUSED["csv"].append(("W,LT\n1,1\n", ": has no column 'name'"))


@pytest.mark.parametrize(("ending", "text", "sentence"), [(ending, *row) for ending, rows in REFUSED.items() for row in rows])
def test_refusals_of_files(ending, text, sentence, tmp_path):
    (tmp_path / f"a.{ending}").write_text(text, encoding="latin-1")
    with pytest.raises(ValueError, match=f"a.{ending}{sentence}"):
        wc.read_fabrics(tmp_path / f"a.{ending}")


def test_the_command_lists_them(capfd):
    """And says where each is from."""
    assert all(fabric.source and fabric.notes and name == fabric.name for name, fabric in wc.fabrics.items())
    code, out, _ = run(capfd, "fabrics")
    assert code == 0 and all(name in out for name in wc.fabrics) and "1673" in out and "Clyde" in out
    drapes = {line.split()[0]: line.split()[-2] for line in out.splitlines()[1 : 1 + len(wc.fabrics)]}
    assert drapes["silk"] == "52.1*" and drapes["denim-wang"] == "–"  # which has no ν₁₂
    code, out, _ = run(capfd, "fabrics", "denim")  # with what is computed
    rows = dict(line.rsplit(maxsplit=1) for line in out.partition("\n\n")[0].splitlines())
    assert code == 0 and rows["fabric"] == "denim" and rows["E₁t N/m"] == "1673" and rows["D₁ µN·m"] == "114.8*"
    assert "* computed, not measured: D as E·t³/12(1 − ν₁₂ν₂₁)" in out and "Penava" not in out
    code, out, _ = run(capfd, "fabrics", "denim-wang")
    assert code == 0 and "D₁ µN·m  16\n" in out and "*" not in out
