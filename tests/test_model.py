"""What is declared and what is built from it: scenes that are refused, copies that differ, and nothing undeclared."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import warp as wp

import warpcloth as wc
from warpcloth.model import DTYPES
from warpcloth.operators import Energy, Gradient, Sums

# 35 vertices, 82 edges, 48 triangles, 62 hinges, 4 corners: all counts differ.
MESH = wc.Mesh.grid(7, 5, pattern="alternating")
VERTICES, EDGES, HINGES = 35, 82, 62


def scene(**fields):
    """A sheet of springs, with other fields."""
    given = {"mesh": MESH, "density": 0.1, "terms": [wc.Spring(stiffness=100.0)], **fields}
    return wc.Scene(**given)


def frames_at(places):
    return np.asarray(places, dtype=float).reshape(1, -1, 3)


def without(values, index, bad):
    changed = np.array(values, dtype=float)
    changed[index] = bad
    return changed


# --- scenes that are refused: fields, part of the message

BAD_SCENES = {
    "no mass": ({"density": None}, "exactly one of density and masses"),
    "two masses": ({"masses": np.ones(VERTICES)}, "exactly one of density and masses"),
    "negative density": ({"density": -1.0}, "density is -1.0"),
    "density NaN": ({"density": np.nan}, "density is nan"),
    "masses of another mesh": ({"density": None, "masses": np.ones(3)}, "masses has shape (3,)"),
    "massless vertex": ({"density": None, "masses": without(np.ones(VERTICES), 9, 0.0)}, "vertex 9 has mass 0.0 kg"),
    "isolated vertex": ({"mesh": wc.Mesh([*np.eye(3), [5, 5, 5]], [[0, 1, 2]])}, "vertex 3 has mass 0.0 kg"),
    "positions of another mesh": ({"positions": np.zeros((3, 3))}, "positions has shape (3, 3)"),
    "position NaN": ({"positions": without(MESH.points, (4, 1), np.nan)}, "positions[4, 1] is nan"),
    "velocity infinite": ({"velocities": without(0 * MESH.points, (4, 1), np.inf)}, "velocities[4, 1] is inf"),
    "gravity a number": ({"gravity": -9.81}, "gravity has shape ()"),
    "gravity a word": ({"gravity": "down"}, "gravity is not numeric"),
    "pin outside": ({"pins": [0, 35]}, "pins.vertices[1] is 35; it must lie in 0 … 34"),
    "pin negative": ({"pins": [-1]}, "pins.vertices[0] is -1"),
    "pin twice": ({"pins": [3, 4, 3]}, "names a vertex twice"),
    "pin a fraction": ({"pins": [0.5]}, "pins.vertices has shape (1,) and type float64"),
    "pin mask": ({"pins": np.ones(VERTICES, dtype=bool)}, "pins.vertices has shape (35,) and type bool"),
    "pins one number": ({"pins": 5}, "pins.vertices has shape ()"),
    "pins in columns": ({"pins": [[0, 1]]}, "pins.vertices has shape (1, 2)"),
    "pins unreadable": ({"pins": "x <"}, "column"),
    "keyframes too few": ({"pins": wc.Pins([0, 1], frames_at(MESH.points[0]))}, "pins.keyframes has shape (1, 1, 3)"),
    "keyframes flat": ({"pins": wc.Pins([0], MESH.points[:1])}, "pins.keyframes has shape (1, 3)"),
    "keyframes empty": ({"pins": wc.Pins([0], np.zeros((0, 1, 3)))}, "pins.keyframes has shape (0, 1, 3)"),
    "keyframes elsewhere": ({"pins": wc.Pins([0], frames_at([0.0, 1.0, 0.0]))}, "1 m from where the pinned vertices start"),
    "keyframe NaN": ({"pins": wc.Pins([0], frames_at([0.0, np.nan, 0.0]))}, "pins.keyframes[0, 0, 1] is nan"),
    "no time": ({"duration": 0.0}, "duration is 0.0 s"),
    "part of a frame": ({"duration": 0.51, "fps": 30.0}, "whole number of frames"),
    "forever": ({"duration": np.inf}, "duration is inf s"),
    "no frame rate": ({"fps": 0.0}, "fps is 0.0"),
    "frame rate NaN": ({"fps": np.nan}, "fps is nan"),
    "no term": ({"terms": [100.0]}, "terms[0] is 100.0"),
}


@pytest.mark.parametrize(("fields", "message"), BAD_SCENES.values(), ids=BAD_SCENES)
def test_bad_scene_is_refused(fields, message):
    with pytest.raises(ValueError) as error:
        scene(**fields)
    assert message in str(error.value)


# Terms that a scene may hold but that do not fit its mesh, and builds that do not fit the scene: part of the message.
BAD_TERMS = {
    "negative": (wc.Spring(stiffness=-1.0), "Spring.stiffness[0] is -1.0"),
    "NaN": (wc.Spring(stiffness=np.nan, name="warp"), "warp.stiffness[0] is nan"),
    "a word": (wc.Spring(stiffness="stiff"), "Spring.stiffness"),
    "one of many": (wc.Spring(stiffness=without(np.ones(EDGES), 5, -2.0)), "Spring.stiffness[5] is -2.0"),
    "too few": (wc.Spring(stiffness=[1.0, 2.0]), "Spring.stiffness has shape (2,)"),
    "unknown pairs": (wc.Spring(stiffness=1.0, pairs="diagonal"), "'diagonal'"),
    "no pairs": (wc.Spring(stiffness=1.0, pairs=[]), "Spring.pairs has shape (0,)"),
    "pair of one": (wc.Spring(stiffness=1.0, pairs=[[0, 1], [2, 2]]), "Spring.pairs[1] is [2, 2]"),
    "pair outside": (wc.Spring(stiffness=1.0, pairs=[[0, 35]]), "Spring.pairs[0] is [0, 35]"),
    "negative length": (wc.Spring(stiffness=1.0, rest_lengths=-1.0), "Spring.rest_lengths[0] is -1.0"),
    "too few lengths": (wc.Spring(stiffness=1.0, rest_lengths=[1.0, 2.0]), "Spring.rest_lengths has shape (2,)"),
    "nothing attached": (wc.Attachment(stiffness=1.0), "Attachment.vertices has shape (0, 1)"),
    "attached outside": (wc.Attachment(stiffness=1.0, vertices=[0, 40]), "Attachment.vertices[1] is [40]"),
    "targets": (wc.Attachment(stiffness=1.0, vertices=[0], targets=[[0, 0]]), "Attachment.targets has shape (1, 2)"),
    "target NaN": (wc.Attachment(stiffness=1.0, vertices=[0], targets=[[0, 0, np.nan]]), "Attachment.targets"),
}


@pytest.mark.parametrize(("term", "message"), BAD_TERMS.values(), ids=BAD_TERMS)
def test_bad_term_is_refused(term, message):
    with pytest.raises(ValueError) as error:
        scene(terms=[term]).build()
    assert message in str(error.value)


@pytest.mark.parametrize("term", [wc.QuadraticBending(stiffness=1.0), wc.DihedralBending(stiffness=1.0)])
def test_a_term_without_elements_is_refused(term):
    with pytest.raises(ValueError, match="has no elements"):
        wc.Scene(wc.Mesh.chain(5), density=0.1, terms=[term]).build()


BAD_BUILDS = {
    "dtype": ({"dtype": "float16"}, "dtype is 'float16'"),
    "device": ({"device": "tpu"}, "tpu"),
    "no copies": ({"copies": 0}, "copies is 0"),
    "half a copy": ({"copies": 1.5}, "copies is 1.5"),
    "unknown": ({"vary": {"wind": [1.0]}}, "vary['wind'] names nothing in this scene"),
    "term that is not there": ({"vary": {"DihedralBending.stiffness": [1.0]}}, "names nothing in this scene"),
    "parameter that is not there": ({"vary": {"Spring.colour": [1.0]}}, "names nothing in this scene"),
    "gravity of one": ({"copies": 2, "vary": {"gravity": [[0, 0, 0]]}}, "vary['gravity'] has shape (1, 3)"),
    "gravity NaN": ({"vary": {"gravity": [[0, np.nan, 0]]}}, "vary['gravity']"),
    "density of three": ({"copies": 2, "vary": {"density": [1.0, 1.0, 1.0]}}, "vary['density'] has shape (3,)"),
    "density below 0": ({"copies": 2, "vary": {"density": [1.0, -1.0]}}, "mass that is not above 0"),
    "stiffness of three": ({"copies": 2, "vary": {"Spring.stiffness": [1.0] * 3}}, "vary['Spring.stiffness'] has shape (3,)"),
    "stiffness below 0": ({"copies": 2, "vary": {"Spring.stiffness": [1.0, -1.0]}}, "Spring.stiffness is -1.0 in a copy"),
    "stiffness NaN": ({"copies": 2, "vary": {"Spring.stiffness": [1.0, np.nan]}}, "Spring.stiffness is nan in a copy"),
    "positions of one": ({"copies": 2, "vary": {"positions": MESH.points}}, "vary['positions'] has shape (35, 3)"),
}


@pytest.mark.parametrize(("build", "message"), BAD_BUILDS.values(), ids=BAD_BUILDS)
def test_bad_build_is_refused(build, message):
    with pytest.raises(ValueError) as error:
        scene().build(**build)
    assert message in str(error.value)


# --- what a scene holds

PINS = {
    "none": (None, []),
    "indices": ([7, 2], [7, 2]),
    "array": (np.array([3], dtype=np.uint8), [3]),
    "selection": ("corners", [0, 6, 28, 34]),
    "record": (wc.Pins("z == 0 and x > 0.9"), [6]),
    "moved": (wc.Pins([0], np.stack([frames_at(MESH.points[0])[0], [[0, 1, 0]]])), [0]),
}


@pytest.mark.parametrize(("pins", "vertices"), PINS.values(), ids=PINS)
def test_pins(pins, vertices, device):
    made = scene(pins=pins)
    assert made.pins.vertices.tolist() == vertices and made.pins.vertices.dtype == np.int32
    model = made.build(device=device, dtype="float64", copies=2)
    held = np.flatnonzero(model.inverse_mass.numpy().reshape(2, -1) == 0.0)
    assert held.tolist() == sorted([*vertices, *(VERTICES + np.array(vertices, dtype=int))])
    assert (model.mass.numpy() > 0.0).all()
    moved = isinstance(pins, wc.Pins) and pins.keyframes is not None
    assert (model.pins is not None) == (model.keyframes is not None) == moved


def test_a_pinned_vertex_needs_no_mass():
    masses = without(np.ones(VERTICES), 3, 0.0)
    model = scene(density=None, masses=masses, pins=[3]).build()
    assert model.inverse_mass.numpy()[3] == 0.0 and np.isfinite(model.inverse_mass.numpy()).all()


def test_lumped_mass():
    sheet, chain = scene(), wc.Scene(wc.Mesh.chain(5, length=2.0), density=0.1)
    assert np.isclose(sheet.masses.sum(), 0.1, rtol=1e-14) and (sheet.masses == 0.1 * MESH.vertex_areas).all()
    assert np.allclose(chain.masses, 0.1 * 2.0 / 4 * np.array([0.5, 1, 1, 1, 0.5]), rtol=1e-14)


def test_a_scene_prints_itself():
    lengths = np.full(EDGES, 0.1)
    made = scene(
        terms=[wc.Spring(stiffness=100.0, rest_lengths=lengths, name="warp"), wc.DihedralBending(stiffness=1e-4)],
        pins=[0, 6],
        duration=0.5,
        name="curtain",
    )
    text = str(made)
    for part in ("curtain", "35 vertices", "48 triangles", "82 edges", "mass 0.1 kg", "30 frames", "pins: 2"):
        assert part in text
    for part in (
        "Spring(stiffness=100.0, name='warp', pairs='edges', rest_lengths=array(82,))",
        "DihedralBending(stiffness=0.0001)",
    ):
        assert part in text
    assert made.frames == 30 and len(text.splitlines()) < 10


# --- the report

TERMS = {
    "none": [],
    "one value": [wc.Spring(stiffness=100.0)],
    "hard": [wc.Spring(stiffness=np.inf)],
    "of each element": [wc.Spring(stiffness=np.linspace(1.0, 2.0, EDGES))],
    "all": [
        wc.Spring(stiffness=100.0),
        wc.QuadraticBending(stiffness=1e-3),
        wc.DihedralBending(stiffness=1e-3),
        wc.Attachment(vertices="corners", stiffness=10.0),
    ],
}


@pytest.mark.parametrize("terms", TERMS.values(), ids=TERMS)
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("copies", [1, 3])
@pytest.mark.filterwarnings("error")
def test_report_counts_what_was_built(terms, dtype, copies, device):
    """The bytes are those that Warp's own tracker saw, and those that the arrays should have."""
    keyframes = np.tile(MESH.points[:1], (4, 1, 1))
    made = scene(terms=terms, pins=wc.Pins([0], keyframes))
    with wp.ScopedMemoryTracker("build", print=False) as tracker:
        tracker.clear()
        model = made.build(device=device, dtype=dtype, copies=copies)
        lines = []
        tracker.report_func = lines.append
        tracker.report(max_items=100)
    report = model.report()
    number = np.dtype(dtype).itemsize
    shared = (3 + 3 + 1 + 1) * number * copies * VERTICES + 3 * number * copies + 4 + 4 * 3 * number
    of_terms = []
    for term, elements in zip(terms, model.terms, strict=True):
        E, K = len(term.stencil(MESH)), term.term.vertices
        values = E * copies if np.ndim(term.stiffness) else 1
        of_terms.append(4 * K * E * copies + number * (term.term.parameters * E * copies + values))
        assert elements.stiffness.strides == ((number,) if np.ndim(term.stiffness) else (0,))
        assert (elements.stiffness.numpy().reshape(copies, E) == np.asarray(term.stiffness, dtype=dtype)).all()
    assert [term["bytes"] for term in report["terms"]] == of_terms
    assert [term["elements"] for term in report["terms"]] == [copies * len(term.stencil(MESH)) for term in terms]
    assert [term["term"] for term in report["terms"]] == [type(term).__name__ for term in terms]
    assert report["bytes"] == shared + sum(of_terms)
    allocations = [line for line in lines[0].splitlines() if " : array" in line]
    assert len(allocations) == 7 + 3 * len(terms)
    # The tracker rounds what it prints to three digits.
    units = {"B": 1, "KB": 1024, "MB": 1024**2}
    tracked = [float(line.split()[0]) * units[line.split()[1]] for line in allocations]
    assert abs(sum(tracked) - report["bytes"]) <= 0.005 * 1024 * len(tracked)
    assert report["vertices"] == copies * VERTICES and report["copies"] == copies and report["dtype"] == dtype
    assert report["kernels"] == []
    json.dumps(report)


def test_report_names_the_kernels(device):
    model = scene().build(device=device)
    Gradient(model)
    assert model.report()["kernels"] == [f"{'gather' if model.device.is_cuda else 'scatter'}_gradient.Spring"]


# --- copies

RANDOM = np.random.default_rng(0)
COPIES = 3
STARTS = MESH.points + RANDOM.normal(scale=0.03, size=(COPIES, VERTICES, 3))
VARIED = {
    "gravity": ([[0, -9.81, 0], [0, -1.62, 0], [1, 2, 3]], lambda value: {"gravity": value}),
    "density": ([0.1, 0.2, 0.4], lambda value: {"density": value}),
    "positions": (STARTS, lambda value: {"positions": value}),
    "velocities": (RANDOM.normal(size=(COPIES, VERTICES, 3)), lambda value: {"velocities": value}),
    "Spring.stiffness": ([10.0, 20.0, 40.0], lambda value: {"terms": all_terms(spring=value)}),
    "bend.stiffness": (
        RANDOM.uniform(1e-3, 2e-3, (COPIES, HINGES)),
        lambda value: {"terms": all_terms(bend=value)},
    ),
    "Attachment.stiffness": (RANDOM.uniform(1, 2, (COPIES, 4)), lambda value: {"terms": all_terms(hold=value)}),
}


def all_terms(spring=100.0, bend=1e-3, hold=10.0):
    return [
        wc.Spring(stiffness=spring),
        wc.QuadraticBending(stiffness=1e-3),
        wc.DihedralBending(stiffness=bend, name="bend"),
        wc.Attachment(vertices="corners", stiffness=hold),
    ]


def energy_and_gradient(model):
    energy, gradient = wp.zeros(model.copies, dtype=wp.float64, device=model.device), model.vectors()
    x = model.array(model.positions.numpy() * 1.05, model.vec3)
    Energy(model, Sums(model)).add(x, energy)
    Gradient(model).add(x, gradient)
    return energy.numpy(), gradient.numpy().reshape(model.copies, -1, 3)


@pytest.mark.parametrize("names", [[name] for name in VARIED] + [list(VARIED)], ids=[*VARIED, "all at once"])
@pytest.mark.parametrize("dtype", DTYPES)
def test_a_copy_is_a_scene_of_its_own(names, dtype, device):
    """Copy b has the arrays, the energy and the forces of a single scene with its parameters, to the bit."""
    fields = {"terms": all_terms(), "pins": [0], "positions": STARTS[0]}
    vary = {name: VARIED[name][0] for name in names}
    batch = scene(**fields).build(device=device, dtype=dtype, copies=COPIES, vary=vary)
    energy, gradient = energy_and_gradient(batch)
    differs = []
    for b in range(COPIES):
        changed = dict(fields)
        if len(names) > 1:
            changed["terms"] = all_terms(*(VARIED[f"{term}.stiffness"][0][b] for term in ("Spring", "bend", "Attachment")))
        for name in names:
            value = VARIED[name][1](VARIED[name][0][b])
            changed |= value if len(names) == 1 or "terms" not in value else {}
        single = scene(**changed).build(device=device, dtype=dtype)
        for field in ("positions", "velocities", "mass", "inverse_mass", "gravity"):
            whole = getattr(batch, field).numpy()
            assert (np.split(whole, COPIES)[b] == getattr(single, field).numpy()).all()
        energy_alone, gradient_alone = energy_and_gradient(single)
        assert energy[b] == energy_alone[0] > 0.0 and (gradient[b] == gradient_alone[0]).all()
        differs.append([energy_alone[0], *single.mass.numpy(), *single.velocities.numpy().ravel(), *single.gravity.numpy()[0]])
    assert (np.ptp(differs, axis=0) > 0.0).any(), "the copies are not alike"


def test_copies_without_differences_are_alike(device):
    batch = scene(terms=all_terms()).build(device=device, copies=COPIES)
    energy, gradient = energy_and_gradient(batch)
    assert (energy == energy[0]).all() and (gradient == gradient[0]).all()
    assert [elements.stiffness.strides for elements in batch.terms] == [(0,)] * 4


# Names given to two spring terms; what is varied; the stiffness of each term in the second copy.
TWO_SPRINGS = {
    "by name": ({"structural.stiffness": [1.0, 2.0]}, [2.0, 5.0]),
    "by the other name": ({"shear.stiffness": [1.0, 2.0]}, [3.0, 2.0]),
    "by class": ({"Spring.stiffness": [1.0, 2.0]}, [2.0, 2.0]),
    "name before class": ({"Spring.stiffness": [1.0, 2.0], "shear.stiffness": [6.0, 7.0]}, [2.0, 7.0]),
}


@pytest.mark.parametrize(("vary", "expected"), TWO_SPRINGS.values(), ids=TWO_SPRINGS)
def test_two_terms_of_a_kind(vary, expected, device):
    terms = [
        wc.Spring(pairs="structural", stiffness=3.0, name="structural"),
        wc.Spring(pairs="shear", stiffness=5.0, name="shear"),
    ]
    model = scene(terms=terms).build(device=device, copies=2, vary=vary)
    assert [term["term"] for term in model.report()["terms"]] == ["structural", "shear"]
    assert [np.unique(elements.stiffness.numpy()[elements.per_copy :]).tolist() for elements in model.terms] == [
        [value] for value in expected
    ]


# --- nothing undeclared

PROBE = """
import inspect, json, os, sys
import warp as wp

launched, rows = {}, set()
launch, make = wp.launch, wp.array.__init__

def recorded_launch(kernel, *args, **kwargs):
    launched[kernel.module.name] = kernel
    return launch(kernel, *args, **kwargs)

def recorded_make(self, *args, **kwargs):
    make(self, *args, **kwargs)
    rows.update(self.shape[:1])

def homes(function, seen):
    # Files of all device functions that a kernel can call, found through what its Python source refers to.
    names = inspect.getclosurevars(function)
    for value in [*names.nonlocals.values(), *names.globals.values()]:
        if isinstance(value, wp.Function) and value.func is not None and value.func not in seen:
            seen.add(value.func)
            homes(value.func, seen)
    return {each.__module__ for each in seen}

wp.launch, wp.array.__init__ = recorded_launch, recorded_make
import numpy as np
import warpcloth as wc

solver, declared, device = sys.argv[1:]
mesh = wc.Mesh.grid(7, 5, pattern="alternating")
terms = [wc.Spring(stiffness=100.0)]
if declared == "all":
    terms += [wc.QuadraticBending(stiffness=1e-4), wc.DihedralBending(stiffness=1e-4)]
    terms += [wc.Attachment(vertices="corners", stiffness=10.0)]
model = wc.Scene(mesh, density=0.1, terms=terms, pins=[0]).build(device=device)
stepper = getattr(wc, solver)(substeps=8).bind(model)
stepper.step()
stepper.step()
wp.synchronize()
assert np.isfinite(stepper.state.x.numpy()).all()
cache = wp.config.kernel_cache_dir
print(json.dumps({
    "homes": sorted(set().union(*(homes(kernel.func, {kernel.func}) for kernel in launched.values()))),
    "named": sorted(model.kernels),
    "launched": sorted(launched),
    "compiled": sorted(name for name in os.listdir(cache) if os.path.isdir(os.path.join(cache, name))),
    "rows": sorted(rows),
}))
"""


def probed(tmp_path, solver, declared, device):
    """What a new process with an empty kernel cache builds, compiles and launches."""
    environment = os.environ | {"WARP_CACHE_PATH": str(tmp_path / "cache"), "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", PROBE, solver, declared, device]
    run = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=300, cwd=Path(__file__).parent)
    assert run.returncode == 0, run.stderr
    found = json.loads(run.stdout.splitlines()[-1])
    found["homes"] = [home.rpartition(".")[2] for home in found["homes"] if ".kernels.terms." in home]
    found["named terms"] = sorted({name.partition(".")[2] for name in found["named"] if "." in name})
    return found


# Solver; terms of the scene; which files of energies are found in kernels; names in the report.
ALL_HOMES = ["attachment", "dihedral_bending", "quadratic_bending", "spring"]
ALL_NAMES = ["Attachment", "DihedralBending", "QuadraticBending", "Spring"]
BUILDS = {
    **{f"{solver} of springs": (solver, "springs", ["spring"], ["Spring"]) for solver in ("Explicit", "Newton", "PBD")},
    "PBD of all, to show that the probe sees them": ("PBD", "all", ALL_HOMES, ALL_NAMES),
}


@pytest.mark.parametrize(("solver", "declared", "homes", "names"), BUILDS.values(), ids=BUILDS)
def test_nothing_undeclared_exists(tmp_path, solver, declared, homes, names, device):
    found = probed(tmp_path, solver, declared, device)
    assert found["homes"] == homes
    assert found["named terms"] == names
    # Each kernel is a module of its own; what was compiled is what was launched, and no more than the report names.
    assert len(found["compiled"]) == len(found["launched"]) <= len(found["named"])
    assert all(any(module in folder for folder in found["compiled"]) for module in found["launched"])
    # One array at least has a row for each element of what is declared, and none has one for anything else.
    assert EDGES in found["rows"]
    assert (HINGES in found["rows"]) == ("QuadraticBending" in names)
    assert (4 in found["rows"]) == ("Attachment" in names)
