"""Texts of values in error messages and records."""

from dataclasses import MISSING, fields, is_dataclass

import numpy as np
import pytest

import warpcloth as wc
from warpcloth.base.checks import shown
from warpcloth.scene.colliders import Collider
from warpcloth.solvers.step import Step
from warpcloth.terms.declared import Declared
from warpcloth.terms.loads import Load

KINDS = (Declared, Load, Collider, Step, wc.Contact, wc.SelfContact, wc.Air, wc.Fabric, wc.Scene, wc.Markers, wc.Reading)
RECORDS = [name for name in wc.__all__ if is_dataclass(record := getattr(wc, name)) and issubclass(record, KINDS)]
MESH = wc.Mesh.grid(3, 3)
# Values of fields without a default, or of which one must be given.
GIVEN = {
    **{"mesh": MESH, "density": 1.0, "terms": [wc.Spring(stiffness=1.0)], "stiffness": 1.0, "name": "a", "vertices": [0]},
    **{"radius": 1.0, "length": 1.0, "size": (1.0, 1.0, 1.0), "points": MESH.points, "triangles": MESH.triangles},
    **{"substeps": 2, "force": (0.0, 1.0, 0.0), "traction": (0.0, 1.0, 0.0), "pressure": 1.0, "most": 1.1},
    **{"positions": np.zeros((1, 1, 3)), "function": len, "value": 1.0},
}
OPTIONAL = ("substeps", "force", "traction", "pressure", "most", "density", "terms")
SCALARS = [np.float64(-1.0), np.float32("nan"), np.float64(0.5), np.int64(-1), np.int64(3), np.str_("no"), np.bool_(True)]
SEVERAL = [[np.float64(-1.0)], (np.float64("nan"), np.int64(1)), {"a": np.float64(1.0)}]


@pytest.mark.parametrize("name", RECORDS)
def test_messages_and_records_have_plain_numbers(name):
    """Where a NumPy scalar is given for a field, also in a list. Runs are resumed by the text of their solver."""
    record, refused = getattr(wc, name), 0
    names = [field.name for field in fields(record) if field.init]
    needed = [field.name for field in fields(record) if field.default is MISSING and field.default_factory is MISSING]
    given = {each: GIVEN[each] for each in names if each in needed or each in OPTIONAL}
    given |= {"vertices": [0]} if record is wc.Markers else {}
    record(**given)
    for each in names:
        others = {other: value for other, value in given.items() if not (each == "dt" and other == "substeps")}
        for value in SCALARS + SEVERAL:
            try:
                made = record(**others | {each: value})
                text = repr(made) if isinstance(value, np.generic) else ""
            except (ValueError, TypeError) as error:
                text, refused = str(error), refused + 1
            assert "np." not in text, (each, value)
    assert refused >= 2


def test_a_number_that_python_lacks_is_shown_plainly():
    assert shown([np.longdouble("-1.5")]) == "[-1.5]"
