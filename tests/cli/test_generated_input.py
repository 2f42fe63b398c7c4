"""Input that Hypothesis makes by changing valid input is accepted, or refused in one sentence that begins with its file."""

import io
import re
import warnings

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import warpcloth as wc
from support.stage_texts import CURVES, MOVED, STAGE
from warpcloth.usd import read_scene

NUMBERS = [
    "0",
    "-1",
    "1",
    "2",
    "99",
    "-2147483649",
    "4294967296",
    "1e18",
    "-1e18",
    "1e-308",
    "1e38",
    "1e308",
    "nan",
    "inf",
    "-inf",
    "None",
]
WORDS = [
    "",
    "x",
    "Cloth",
    "/Cloth",
    "points",
    "edges",
    "Spring",
    "QuadraticBending",
    "periodic",
    "Z",
    "\\x1b[31m",
    "none",
    "face",
]
# All but surrogates, as by default, which Hypothesis would find by encoding each character.
CHARACTERS = st.characters(exclude_categories=["Cs"])
TYPES = ["int", "int[]", "float[]", "double", "double3[]", "string", "token[]", "asset", "bool", "matrix4d", "point3f[]"]


def generated(count, thorough):
    """Makes a test with a given number of inputs, and one marked slow with many more; the inputs are the same each time."""

    def decorate(test):
        def run(examples, *arguments):
            checks = list(HealthCheck)
            own = settings(max_examples=examples, deadline=None, derandomize=True, database=None, suppress_health_check=checks)
            own(test)(*arguments)

        return run

    return decorate, pytest.mark.parametrize("examples", [count, pytest.param(thorough, marks=pytest.mark.slow)])


@st.composite
def edited(draw, texts, words=WORDS):
    """A text with one to three numbers, words, types or lines of it replaced, repeated or left out."""
    text = draw(st.sampled_from(texts))
    for _ in range(draw(st.integers(1, 3))):
        pattern, others = draw(
            st.sampled_from(
                [
                    (r"(?<![\w.])-?\d+\.?\d*(e-?\d+)?", st.sampled_from(NUMBERS)),
                    (r'(?<=")[^"\n]*(?=")', st.sampled_from(words)),
                    (r"\b(?:int|float|double|double3|token|string|point3f)(?:\[\])?(?= )", st.sampled_from(TYPES)),
                    (r"\[[^\]]*\]", st.sampled_from(["[]", "[0]", "None", "[(0, 0, 0)]", "[nan, nan, nan]"])),
                    (r"[^\n]*\n", st.sampled_from(["", "\n"]) | st.text(CHARACTERS, max_size=8)),
                ]
            )
        )
        found = list(re.finditer(pattern, text))
        if found:
            place = draw(st.sampled_from(found))
            text = text[: place.start()] + draw(others) + text[place.end() :]
    return text


@st.composite
def damaged(draw, contents):
    """Generates bytes that are truncated or have a few other bytes in them."""
    data = bytearray(draw(st.sampled_from(contents)))
    for _ in range(draw(st.integers(0, 3))):
        place = draw(st.integers(0, max(len(data) - 1, 0)))
        data[place : place + draw(st.integers(0, 4))] = draw(
            st.binary(max_size=4) | st.sampled_from([b"-1", b"nan", b"1e999", b" ", b"\n"])
        )
    return bytes(data[: draw(st.integers(0, len(data)) | st.just(len(data)))])


def refused_in_a_sentence(path, read, *arguments):
    """Whether a reader refuses a file; checks that it does so in one sentence."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        warnings.simplefilter("ignore", UserWarning)
        try:
            read(path, *arguments)
        except ValueError as error:
            assert str(error).startswith(str(path)), error
            assert "\n" not in str(error) and len(str(error)) < 2000
            return True
    return False


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    return tmp_path_factory.mktemp("generated")


STAGES, _ = generated(1000, 1000)


@pytest.mark.slow
@pytest.mark.parametrize("examples", [1000])
def test_stages(place, capfd, examples):
    @STAGES
    @given(edited([STAGE, MOVED, CURVES]))
    def check(text):
        path = place / "cloth.usda"
        path.write_text(text)
        refused_in_a_sentence(path, read_scene)
        refused_in_a_sentence(path, wc.open_sequence)

    check(examples)
    assert capfd.readouterr().err == ""


def texts_of_meshes():
    mesh = wc.Mesh.grid(3, 3)
    points = "".join("{} {} {}\n".format(*point) for point in mesh.points)
    faces = "".join("3 {} {} {}\n".format(*corners) for corners in mesh.triangles)
    head = "ply\nformat ascii 1.0\nelement vertex 9\nproperty float x\nproperty float y\nproperty float z\n"
    head += "element face 8\nproperty list uchar int vertex_indices\nend_header\n"
    corners = "".join(f"vertex {' '.join(map(str, mesh.points[v]))}\n" for v in mesh.triangles[0])
    return {
        "obj": "".join(f"v {line}\n" for line in points.splitlines())
        + "".join("f {} {} {}\n".format(*(corners + 1)) for corners in mesh.triangles),
        "ply": head + points + faces,
        "off": f"OFF\n9 8 0\n{points}{faces}",
        "stl": f"solid cloth\nfacet normal 0 1 0\nouter loop\n{corners}endloop\nendfacet\nendsolid cloth\n",
    }


FILES, counts = generated(40, 300)


@counts
@pytest.mark.parametrize("ending", ["obj", "ply", "off", "stl"])
def test_meshes(place, ending, examples, recwarn):
    @FILES
    @given(
        edited([texts_of_meshes()[ending]]).map(lambda text: text.encode(errors="replace"))
        | damaged([texts_of_meshes()[ending].encode()])
    )
    def check(data):
        path = place / f"cloth.{ending}"
        path.write_bytes(data)
        refused_in_a_sentence(path, wc.Mesh.load)

    check(examples)


def arrays(ending):
    mesh, file = wc.Mesh.grid(2, 2), io.BytesIO()
    frames = np.repeat(mesh.points[None], 3, axis=0).astype(np.float32)
    if ending == "npy":
        np.save(file, frames)
    else:
        np.savez(file, points=frames, triangles=mesh.triangles, times=np.arange(3.0))
    return file.getvalue()


ARRAYS, counts = generated(60, 300)


@counts
@pytest.mark.parametrize("ending", ["npy", "npz"])
def test_arrays(place, ending, examples):
    mesh = wc.Mesh.grid(2, 2)

    def read(path):
        sequence = wc.open_sequence(path, mesh=mesh)
        for frame in range(min(len(sequence), 4)):
            sequence[frame]

    @ARRAYS
    @given(damaged([arrays(ending)]))
    def check(data):
        path = place / f"frames.{ending}"
        path.unlink(missing_ok=True)  # the one before may still be mapped
        path.write_bytes(data)
        refused_in_a_sentence(path, read)

    check(examples)


SELECTIONS, counts = generated(200, 1400)
TOKENS = "x y z < <= == != >= > all boundary corners nearest index ( ) , : and or not 0 1 2.5 -1 1e999 99 edge ' \x1b".split(
    " "
)


@counts
def test_selections(examples):
    mesh = wc.Mesh.grid(4, 3)

    @SELECTIONS
    @given(st.lists(st.sampled_from(TOKENS) | st.text(CHARACTERS, max_size=3), max_size=12).map(" ".join))
    def check(text):
        try:
            chosen = mesh.select(text)
        except ValueError as error:
            assert re.match(r"selection .*, column \d+: ", str(error)) and "\n" not in str(error) and "\x1b" not in str(error)
        else:
            assert chosen.dtype == np.int32 and (np.diff(chosen) > 0).all()

    check(examples)
