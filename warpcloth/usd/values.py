"""Reads values of a stage with checks, so that a wrong value is refused by its name before any arithmetic uses it."""

import os
import textwrap
import unicodedata
import warnings
from contextlib import contextmanager, redirect_stderr
from io import StringIO

import numpy as np

from ..base.checks import shown
from .modules import Tf, Usd, UsdGeom, UsdPhysics, UsdUtils

# Beyond it neighbouring time codes, which are float64, are more than 1e-7 apart and cannot tell frames apart.
MOST_TIME_CODE = 1e9
# Range of frames and time codes per second: from one in eleven days to one per microsecond.
_RATES = (1e-6, 1e6)
# Range of metres and kilograms per unit: a light year is 1e16 m.
_UNITS = (1e-18, 1e18)

_listening = False


@contextmanager
def sentences(path, raised=ValueError, what=""):
    """Turns what pxr says about a file into sentences: errors are raised, and warnings become Python warnings.

    Args:
        path: The file.
        raised: Type of the exception.
        what: Text before the words of pxr.

    Raises:
        ValueError: pxr has reported an error; ``raised`` gives another type.
    """
    global _listening
    heard = None if _listening else UsdUtils.CoalescingDiagnosticDelegate()  # nested delegates would all get every message
    _listening = True
    try:
        yield
    except Tf.ErrorException as error:
        raise raised(f"{path}: {what}{reason_of(error)}") from None
    except UnicodeDecodeError:  # from a name or text that pxr returns
        raise raised(f"{path}: {what}it holds text that is no valid UTF-8") from None
    finally:
        if heard:
            _listening = False
            said = heard.TakeUncoalescedDiagnostics()
    if heard:
        for text in dict.fromkeys(_plain(each.commentary) for each in said):  # not where an error says what is wrong
            warnings.warn(f"{path}: {text}", stacklevel=4)


def reason_of(error):
    """Returns the first sentence of a pxr error."""
    first = error.args[0] if error.args else error
    return _plain(getattr(first, "commentary", str(first)))


def _plain(text):
    """Shortens a text of pxr, without its line breaks and the address of the stage in memory."""
    return textwrap.shorten(text.partition(" (instantiating stage on")[0], 500, placeholder=" …")


def refuse_path(path):
    """Refuses a path that no layer can refer to.

    Raises:
        ValueError: It has control characters, such as a line break, or is not UTF-8.
    """
    text = os.fspath(path)
    if any(unicodedata.category(character) in ("Cc", "Cs") for character in text):
        raise ValueError(f"{text!r}: a path in USD must be UTF-8 without line breaks and other control characters")


def check_stage(stage, path):
    """Refuses units, rates and times that no stage can have.

    Raises:
        ValueError: One is not finite, or not above 0; the up axis is neither Y nor Z; a layer below is missing; the end is
            before the start.
    """
    for error in stage.GetCompositionErrors():
        if type(error).__name__ == "ErrorInvalidSublayerPath":
            raise ValueError(f"{path}: {_plain(str(error))} It must be there, because it may hold a part of the cloth")
    units = {
        "metersPerUnit": UsdGeom.GetStageMetersPerUnit(stage),
        "kilogramsPerUnit": UsdPhysics.GetStageKilogramsPerUnit(stage),
    }
    for name, value in units.items():
        _refuse_outside(path, name, value, *_UNITS)
    axis = UsdGeom.GetStageUpAxis(stage)
    if axis not in ("Y", "Z"):
        raise ValueError(f'{path}: upAxis is {shown(str(axis))}, must be "Y" or "Z"')
    for layer in stage.GetUsedLayers():
        where = path if layer == stage.GetRootLayer() else f"{path}, layer {layer.identifier}"
        for name in ("timeCodesPerSecond", "framesPerSecond"):
            rate = getattr(layer, name)
            _refuse_outside(where, name, rate, *_RATES)
        for name in ("startTimeCode", "endTimeCode"):
            _refuse_outside(where, name, getattr(layer, name), -MOST_TIME_CODE, MOST_TIME_CODE)
    if stage.HasAuthoredTimeCodeRange() and stage.GetEndTimeCode() < stage.GetStartTimeCode():
        end, start = stage.GetEndTimeCode(), stage.GetStartTimeCode()
        raise ValueError(f"{path}: endTimeCode is {end:g}, must be at least startTimeCode, which is {start:g}")


def check_composed(prim, path):
    """Refuses a prim that is incomplete because a file that it or a prim above it refers to is missing.

    Raises:
        ValueError: pxr could not compose it.
    """
    for error in prim.GetStage().GetCompositionErrors():
        if prim.GetPath().HasPrefix(error.rootSite.path) or error.rootSite.path.HasPrefix(prim.GetPath()):
            raise ValueError(f"{path}, prim {prim.GetPath()}: {_plain(str(error))} It must be there")


def _refuse_outside(where, name, value, least, most):
    if not least <= value <= most:
        raise ValueError(f"{where}: {name} is {shown(value)}, must be a number of {least:g} to {most:g}")


def value_of(attribute, time=None):
    """Returns the value of an attribute at a time code, or at the default time; None if it has none.

    Raises:
        ValueError: The file is broken there, or holds a type that Python does not have.
    """
    try:
        with redirect_stderr(StringIO()):  # pxr prints a value that it cannot convert to Python
            return attribute.Get(Usd.TimeCode.Default() if time is None else time)
    except UnicodeDecodeError:
        raise ValueError(f"{attribute.GetName()} is no valid UTF-8") from None
    except (Tf.ErrorException, TypeError) as error:
        raise ValueError(f"{attribute.GetName()} cannot be read ({reason_of(error)})") from None


def token_of(attribute, allowed):
    """Returns the value of an attribute that takes one of some words.

    Raises:
        ValueError: It has another value.
    """
    value = value_of(attribute)
    if value not in allowed:
        raise ValueError(f"{attribute.GetName()} is {shown(value)}, must be one of {', '.join(map(str, allowed))}")
    return value


def array_of(attribute, components=(), whole=False, time=None):
    """Returns the rows of an array attribute (count, *components), as int32 if ``whole``; None if it has no value.

    Raises:
        ValueError: The rows have another type or shape, or cannot be read.
    """
    value = value_of(attribute, time)
    return None if value is None else checked_rows(attribute.GetName(), value, components, whole)


def checked_rows(name, value, components=(), whole=False):
    """Returns the rows of a value, with the checks of :func:`array_of`."""
    rows = np.array(value)
    if rows.dtype.kind not in ("iu" if whole else "iuf") or rows.shape[1:] != components or rows.ndim != 1 + len(components):
        kind = "whole numbers" if whole else f"rows of {components[0]} numbers" if components else "numbers"
        raise ValueError(f"{name} holds {rows.dtype} of shape {rows.shape}, must be {kind}")
    return rows.astype(np.int32) if whole else rows


def refuse_outside(name, numbers, count, what):
    """Refuses numbers that are not indices from 0 to ``count`` − 1.

    Raises:
        ValueError: One is out of range; the message names the first.
    """
    wrong = (numbers < 0) | (numbers >= count)
    if wrong.any():
        first = int(np.argmax(wrong))
        raise ValueError(f"{name}[{first}] = {numbers[first]}, must be a {what}, 0 to {count - 1}")


def refuse_unknown(name, values, where="", infinite=False):
    """Refuses numbers that are not finite, or with ``infinite`` only NaN.

    Raises:
        ValueError: There is one; the message names the first.
    """
    wrong = np.isnan(values) if infinite else ~np.isfinite(values)
    for entry in np.argwhere(wrong)[:1].tolist():
        index = "".join(f"[{i}]" for i in entry)
        raise ValueError(f"{name}{index}{where} is {values[tuple(entry)]}, must be {'a number' if infinite else 'finite'}")


def time_codes_of(attribute):
    """Lists the time codes of the samples of an attribute.

    Raises:
        ValueError: A time code is too large to be told from its neighbours.
    """
    codes = attribute.GetTimeSamples()
    for code in codes:
        if not abs(code) <= MOST_TIME_CODE:
            raise ValueError(
                f"{attribute.GetName()} has a sample at time code {code:g}, "
                f"must be at -{MOST_TIME_CODE:g} to {MOST_TIME_CODE:g}"
            )
    return codes
