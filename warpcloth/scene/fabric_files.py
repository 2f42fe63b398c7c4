"""Reads fabrics from material files of ARCSim and tables of KES-F and FAST."""

import json
import math
import re
from pathlib import Path

from ..base.checks import shown
from ..base.tables import distinct, number_in, read_table
from ..base.types import FilePath
from .fabric import Fabric

_GRAM_FORCE = 9.80665e-3  # [N], exactly
_PER_CM = 100.0 * _GRAM_FORCE  # gf/cm [N/m]
_ROUNDED = 0.1  # largest logarithm of the ratio of a linearity to that from EMT and WT; tables round them
_MIN, _MAX = 1e-4, 1e6  # of a reading, in the unit of the device
_RESOLVED = 0.005  # smallest difference of two extensions from which a modulus follows [%]
_ENDS = {"1": 1, "warp": 1, "2": 2, "weft": 2}

_ARCSIM = (
    "From a material file of ARCSim (Narain, Samii and O'Brien 2012). Moduli are those at zero strain, as its code takes them: "
    "twice the first row of the stretching table, none below 0; Young's moduli and ν₁₂ follow from these entries k₁, k₁₂, k₂, "
    "and Gt is a quarter of the entry that multiplies E₁₂². D₁ and D₂ are a quarter of the first entries of the bending table "
    "at 0° and 90°. They are uncertain by a factor of 4, by which the paper that measured such tables (Wang, O'Brien and "
    "Ramamoorthi 2011) and the code differ. The other entries, at larger strains and curvatures, are left out."
)
_KES = (
    "From KES-F measurements (Kawabata 1980, The standardization and analysis of hand evaluation). Moduli are 2WT/EMT²: linear "
    "fabric then stores the work WT at the extension EMT by 500 gf/cm; near zero strain real fabric is softer. Gt is G per "
    "degree, from 0.5° to 2.5°, and the mean of both directions. Poisson's ratio is not measured."
)
_FAST = (
    "From FAST measurements (De Boos and Tester 1994, SiroFAST). Moduli are 15 gf/cm over E20 − E5, as in its formability, or "
    "100 gf/cm over E100. Gt is that of the bias extension by 5 gf/cm, 123/EB5. D is W C³ g from the bending length at 41.5°. "
    "Poisson's ratio is not measured."
)


def read_fabrics(path: FilePath) -> dict[str, Fabric]:
    """Reads fabrics from a file, by name.

    A .json file is a material of ARCSim: density [kg/m²], stretching [N/m], bending [N·m], named as the file. A .csv file has a
    fabric in each row, with a column ``name`` and columns of KES-F or FAST, named as in docs/fabrics.md. ``notes`` says what
    was derived and ignored.

    Raises:
        OSError: The file cannot be read.
        ValueError: It is of another kind, a name occurs twice, a number is not allowed, EMT, WT and LT contradict, or E20 is
            not above E5 by 0.005 %.
    """
    ending = Path(path).suffix.lower()
    if ending == ".json":
        fabric = _arcsim(path)
        return {fabric.name: fabric}
    if ending != ".csv":
        raise ValueError(
            f"{path}: is a {ending or 'file without an ending'}; it must be .json of ARCSim or .csv of KES-F or FAST"
        )
    return _table(path)


def _arcsim(path):
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
        text = re.sub(r'("(?:[^"\\]|\\.)*")|//[^\n]*', lambda match: match[1] or "", text)
        found = json.loads(text, parse_int=float, object_pairs_hook=distinct)  # int() refuses very many digits
    except json.JSONDecodeError as error:
        raise ValueError(f"{path}, line {error.lineno}: {error.msg}; it must be JSON") from None
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: is no text in UTF-8, {error}") from None
    except RecursionError:
        raise ValueError(f"{path}: is nested too deeply; it must be a JSON object of numbers and rows of numbers") from None
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    if not isinstance(found, dict):
        raise ValueError(f"{path}: is {shown(found)}; it must be a JSON object")
    for name in ("density", "stretching", "bending"):
        if name not in found:
            raise ValueError(f"{path}: has no {name}; a material of ARCSim must have density, stretching and bending")
    stretching = found["stretching"]
    if isinstance(stretching, list) and stretching and isinstance(stretching[0], list):
        stretching = stretching[0]
    bending = found["bending"]
    along = [row[0] for row in bending if isinstance(row, list) and row] if isinstance(bending, list) else []
    if len(along) != 3 or not all(map(_is_number, along)):
        raise ValueError(f"{path}: bending is {shown(bending)}; it must be rows of numbers [N·m] for 0°, 45° and 90°")
    if not (isinstance(stretching, list) and len(stretching) == 4 and all(map(_is_number, stretching))):
        raise ValueError(f"{path}: stretching begins with {shown(stretching)}; it must be a row of 4 numbers [N/m]")
    k1, k12, k2, shear = (2.0 * max(value, 0.0) for value in stretching)
    definite = k1 > 0.0 and k2 > 0.0 and (k12 / k1) * (k12 / k2) < 1.0  # products may overflow
    if not (definite and shear > 0.0):
        rule = "the fourth number must be above 0" if definite else "k₁₂² must be below k₁k₂"
        raise ValueError(f"{path}: stretching begins with {shown(stretching)}, k₁, k₁₂, k₂ and the shear; {rule}")
    if not (along[0] > 0.0 and along[2] > 0.0):
        raise ValueError(f"{path}: bending begins with {along[0]:g} at 0° and {along[2]:g} at 90°; they must be above 0")
    ratio = k12 / k2
    given = {"warp": k1 - ratio * k12, "weft": k2 - ratio * k12 * (k2 / k1), "poisson_ratio": ratio}
    given |= {"shear": shear / 4.0, "bending_warp": along[0] / 4.0, "bending_weft": along[2] / 4.0}
    return _fabric(str(path), Path(path).stem, density=found["density"], **given, source=str(Path(path).name), notes=_ARCSIM)


def _table(path):
    names, rows = read_table(path)
    kinds = {kind: known for kind, known in _COLUMNS.items() if any(_matched(name, known[2]) for name in names)}
    if len(kinds) != 1:
        has = "columns of both" if kinds else "no columns of either"
        raise ValueError(f"{path}: has {has} KES-F (EMT, WT, LT) and FAST (E5, E20, E100, EB5, C); it must have those of one")
    if "name" not in names:
        raise ValueError(f"{path}: has no column 'name'; it must name each fabric")
    ((columns, convert, _own),) = kinds.values()
    keys = _keys(path, names, columns)
    ignored = [name for k, name in enumerate(names) if name != "name" and k not in keys.values()]
    found = {}
    for line, row in rows:
        name = row[names.index("name")]
        if not name or name in found:
            raise ValueError(
                f"{path}, line {line}: name is {name!r}{', as before' if name else ''}; each fabric must have its own"
            )
        values = {key: number_in(path, line, names[k], row[k]) for key, k in keys.items() if row[k]}
        for key, value in values.items():
            if not _MIN <= value <= _MAX:
                rule = f"it must be a number from {_MIN:g} to {_MAX:g}, in the unit of the device"
                raise ValueError(f"{path}, line {line}: {names[keys[key]]} is {value}; {rule}")
        try:
            given = convert(values)
        except ValueError as error:
            raise ValueError(f"{path}, line {line}: {error}") from None
        if given["density"] is None:
            raise ValueError(f"{path}, line {line}: fabric {name!r} has no W, the weight; it must have one")
        if ignored:
            given["notes"] += f" Columns that were ignored: {', '.join(ignored)}."
        found[name] = _fabric(f"{path}, line {line}", name, **given, source=Path(path).name)
    return found


def _fabric(where, name, **given):
    try:
        return Fabric(name=name, **given)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None


def _is_number(value):
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _matched(text, names):
    if text in names:  # T2 is a number of FAST, and not that of the weft
        return text, None
    for name in names:
        between = r"[\s_-]+" if name[-1].isdigit() else r"[\s_-]*"
        match = re.fullmatch(rf"{name}(?:{between}(1|2|warp|weft))?", text)
        if match:
            return name, _ENDS.get(match[1])
    return None


def _keys(path, names, columns):
    found: dict[tuple[str, int], int] = {}
    for k, text in enumerate(names):
        match = _matched(text, columns)
        if match is None:
            continue
        for direction in (1, 2) if match[1] is None else match[1:]:
            if (match[0], direction) in found:
                before = names[found[match[0], direction]]
                raise ValueError(f"{path}: columns {before!r} and {text!r} are the same number; it must have one of them")
            found[match[0], direction] = k
    return found


def _of_kes(values):
    force, moduli = 500.0 * _PER_CM, []
    for direction in (1, 2):
        percent, work, linearity = (values.get((name, direction)) for name in ("EMT", "WT", "LT"))
        strain = None if percent is None else percent / 100.0
        work = None if work is None else work * _PER_CM  # gf·cm/cm² is gf/cm
        derived = 2.0 * work / (force * strain) if work and strain else None
        if work and strain and derived and derived > 2.0:
            raise ValueError(
                f"WT of direction {direction} is {work / _PER_CM:g}; it must be at most 500 gf/cm·EMT, {500.0 * strain:g}"
            )
        if derived and linearity and abs(math.log(derived / linearity)) > _ROUNDED:
            raise ValueError(
                f"LT of direction {direction} is {linearity:g}, but 2WT/(500 gf/cm·EMT) is {derived:.3g}; must agree to 10 %"
            )
        if strain is None and work and linearity:
            strain = 2.0 * work / (linearity * force)
        if work is None and strain and linearity:
            work = 0.5 * linearity * force * strain
        moduli.append(2.0 * work / strain**2 if work and strain else None)
    shear = _mean(values, "G")
    return {
        "density": _times(1e-2, values.get(("W", 1))),
        "thickness": _times(1e-3, values.get(("T", 1))),
        "warp": moduli[0],
        "weft": moduli[1],
        "shear": _times(_PER_CM * 180.0 / math.pi, shear),
        "bending_warp": _times(1e-2 * _GRAM_FORCE, values.get(("B", 1))),  # gf·cm²/cm is gf·cm
        "bending_weft": _times(1e-2 * _GRAM_FORCE, values.get(("B", 2))),
        "notes": _KES,
    }


def _of_fast(values):
    density, moduli, bending, notes = _times(1e-3, values.get(("W", 1))), [], [], _FAST
    for direction in (1, 2):
        low, middle, high, D, length = (values.get((name, direction)) for name in ("E5", "E20", "E100", "B", "C"))
        modulus = "E₁t" if direction == 1 else "E₂t"
        if low is not None and middle is not None:
            if not middle - low >= _RESOLVED:
                raise ValueError(
                    f"E20 of direction {direction} is {middle}, E5 is {low}; E20 must be larger by {_RESOLVED} or more"
                )
            moduli.append(15.0 * _PER_CM / ((middle - low) / 100.0))
            notes += f" {modulus} is from E20 − E5."
        else:
            moduli.append(None if high is None else 100.0 * _PER_CM / (high / 100.0))
            notes += "" if high is None else f" {modulus} is from E100."
        if D is None and length is not None and density is not None:
            D = 1e6 * density * 9.81 * (1e-3 * length) ** 3
        bending.append(_times(1e-6, D))
    extension, shear = values.get(("EB5", 1)), _mean(values, "G")
    if shear is None and extension is not None:
        shear = 5.0 * _PER_CM / (4.0 * extension / 100.0)  # 123/EB5
    thickness = values.get(("T", 1), values.get(("T2", 1)))
    given = {"density": density, "thickness": _times(1e-3, thickness), "shear": shear, "notes": notes}
    return given | dict(zip(("warp", "weft", "bending_warp", "bending_weft"), (*moduli, *bending), strict=True))


def _mean(values, name):
    found = [values[name, direction] for direction in (1, 2) if (name, direction) in values]
    return sum(found) / len(found) if found else None


def _times(factor, value):
    return None if value is None else factor * value


# Names of columns, function that converts their numbers, and names by which a table is recognised.
_COLUMNS = {
    "KES-F": (("W", "T", "B", "G", "EMT", "WT", "LT"), _of_kes, ("EMT", "WT", "LT")),
    "FAST": (
        ("W", "T", "T2", "B", "C", "G", "EB5", "E5", "E20", "E100"),
        _of_fast,
        ("E5", "E20", "E100", "EB5", "C"),
    ),
}
