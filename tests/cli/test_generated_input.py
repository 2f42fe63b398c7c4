"""Input that Hypothesis makes by changing valid input is accepted, or refused in one sentence that begins with its file."""

import io
import re
import warnings

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import warpcloth as wc
from support.mesh_texts import TEXTS
from support.stage_texts import CURVES, MOVED, STAGE
from warpcloth.usd import read_scene

NUMBERS = "0 -1 1 2 99 -2147483649 4294967296 1e18 -1e18 1e-308 1e38 1e308 nan inf -inf None".split()
WORDS = ["", *r"x Cloth /Cloth points edges Spring QuadraticBending periodic Z \x1b[31m none face".split()]
# All but surrogates, as by default, which Hypothesis would find by encoding each character.
CHARACTERS = st.characters(exclude_categories=["Cs"])
TYPES = ["int", "int[]", "float[]", "double", "double3[]", "string", "token[]", "asset", "bool", "matrix4d", "point3f[]"]


def sizes(count, thorough):
    """Numbers of inputs, of which the second, many more, is slow."""
    return pytest.mark.parametrize("examples", [count, pytest.param(thorough, marks=pytest.mark.slow)])


def examine(check, strategy, examples):
    """Checks so many inputs, which are the same each time."""
    checks = list(HealthCheck)
    own = settings(max_examples=examples, deadline=None, derandomize=True, database=None, suppress_health_check=checks)
    own(given(strategy)(check))()


PATTERNS = [
    (r"(?<![\w.])-?\d+\.?\d*(e-?\d+)?", st.sampled_from(NUMBERS)),
    (r'(?<=")[^"\n]*(?=")', st.sampled_from(WORDS)),
    (r"\b(?:int|float|double|double3|token|string|point3f)(?:\[\])?(?= )", st.sampled_from(TYPES)),
    (r"\[[^\]]*\]", st.sampled_from(["[]", "[0]", "None", "[(0, 0, 0)]", "[nan, nan, nan]"])),
    (r"[^\n]*\n", st.sampled_from(["", "\n"]) | st.text(CHARACTERS, max_size=8)),
]


@st.composite
def edited(draw, *texts):
    """A text with one to three numbers, words, types or lines of it replaced, repeated or left out."""
    text = draw(st.sampled_from(texts))
    for _ in range(draw(st.integers(1, 3))):
        pattern, others = draw(st.sampled_from(PATTERNS))
        found = list(re.finditer(pattern, text))
        if found:
            place = draw(st.sampled_from(found))
            text = text[: place.start()] + draw(others) + text[place.end() :]
    return text


@st.composite
def damaged(draw, content):
    """Generates bytes that are truncated or have a few other bytes in them."""
    data, others = bytearray(content), st.sampled_from([b"-1", b"nan", b"1e999", b" ", b"\n"])
    for _ in range(draw(st.integers(0, 3))):
        place = draw(st.integers(0, max(len(data) - 1, 0)))
        data[place : place + draw(st.integers(0, 4))] = draw(st.binary(max_size=4) | others)
    return bytes(data[: draw(st.integers(0, len(data)) | st.just(len(data)))])


def check_refusal(path, read):
    """If a reader refuses a file, it does so in one sentence."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        warnings.simplefilter("ignore", UserWarning)
        try:
            read(path)
        except ValueError as error:
            assert str(error).startswith(str(path)), error
            assert "\n" not in str(error) and len(str(error)) < 2000


@pytest.mark.slow
def test_stages(tmp_path, capfd):
    def check(text):
        path = tmp_path / "cloth.usda"
        path.write_text(text)
        check_refusal(path, read_scene)
        check_refusal(path, wc.open_sequence)

    examine(check, edited(STAGE, MOVED, CURVES), 1000)
    assert capfd.readouterr().err == ""


GRID = wc.Mesh.grid(3, 3)
CORNERS = "".join(f"vertex {' '.join(map(str, GRID.points[v]))}\n" for v in GRID.triangles[0])
MESHES = {ending: TEXTS[ending](GRID.points, GRID.triangles.tolist()) for ending in ("obj", "ply", "off")}
MESHES["stl"] = f"solid cloth\nfacet normal 0 1 0\nouter loop\n{CORNERS}endloop\nendfacet\nendsolid cloth\n"


@sizes(40, 300)
@pytest.mark.parametrize("ending", MESHES)
def test_meshes(tmp_path, ending, examples, recwarn):
    def check(data):
        path = tmp_path / f"cloth.{ending}"
        path.write_bytes(data if isinstance(data, bytes) else data.encode(errors="replace"))
        check_refusal(path, wc.Mesh.load)

    examine(check, edited(MESHES[ending]) | damaged(MESHES[ending].encode()), examples)


@sizes(60, 300)
@pytest.mark.parametrize("ending", ["npy", "npz"])
def test_arrays(tmp_path, ending, examples):
    mesh, file, path = wc.Mesh.grid(2, 2), io.BytesIO(), tmp_path / f"frames.{ending}"
    frames = np.repeat(mesh.points[None], 3, axis=0).astype(np.float32)
    if ending == "npy":
        np.save(file, frames)
    else:
        np.savez(file, points=frames, triangles=mesh.triangles, times=np.arange(3.0))

    def read(path):
        sequence = wc.open_sequence(path, mesh=mesh)
        for frame in range(min(len(sequence), 4)):
            sequence[frame]

    def check(data):
        path.unlink(missing_ok=True)  # the one before may still be mapped
        path.write_bytes(data)
        check_refusal(path, read)

    examine(check, damaged(file.getvalue()), examples)


TOKENS = "x y z < <= == != >= > all boundary corners nearest index ( ) , : and or not 0 1 2.5 -1 1e999 99 edge ' \x1b".split(
    " "
)


@sizes(200, 1400)
def test_selections(examples):
    mesh = wc.Mesh.grid(4, 3)

    def check(text):
        try:
            chosen = mesh.select(text)
        except ValueError as error:
            assert re.match(r"selection .*, column \d+: ", str(error)) and "\n" not in str(error) and "\x1b" not in str(error)
        else:
            assert chosen.dtype == np.int32 and (np.diff(chosen) > 0).all()

    examine(check, st.lists(st.sampled_from(TOKENS) | st.text(CHARACTERS, max_size=3), max_size=12).map(" ".join), examples)
