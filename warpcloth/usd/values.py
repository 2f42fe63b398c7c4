"""Reads and checks values of a stage; errors name the attribute."""

import os
import textwrap
import unicodedata
import warnings
from contextlib import contextmanager, redirect_stderr
from io import StringIO

import numpy as np

from ..base.checks import shown
from .modules import Tf, Usd, UsdGeom, UsdPhysics, UsdUtils

# Beyond it, neighbouring float64 time codes are more than 1e-7 apart, too far to distinguish frames.
MAX_TIME_CODE = 1e9
# Range of frames and time codes per second: from one in eleven days to one per microsecond.
_RATES = (1e-6, 1e6)
# Range of metres and kilograms per unit: a light year is 1e16 m.
_UNITS = (1e-18, 1e18)

_listening = False


@contextmanager
def sentences(path, raised=ValueError, what=""):
    """Context that turns pxr's errors about a file into exceptions ``raised``, and its warnings into Python's."""
    global _listening
    heard = None if _listening else UsdUtils.CoalescingDiagnosticDelegate()  # every nested delegate would get all messages
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
        for text in dict.fromkeys(_plain(each.commentary) for each in said):  # not after an error
            warnings.warn(f"{path}: {text}", stacklevel=4)


def reason_of(error):
    """Returns the first sentence of a pxr error."""
    first = error.args[0] if error.args else error
    return _plain(getattr(first, "commentary", str(first)))


def _plain(text):
    return textwrap.shorten(text.partition(" (instantiating stage on")[0], 500, placeholder=" …")


def refuse_path(path):
    """Raises ValueError if a path has control characters, or is not UTF-8, as a layer cannot refer to it."""
    text = os.fspath(path)
    if any(unicodedata.category(character) in ("Cc", "Cs") for character in text):
        raise ValueError(f"{text!r}: a path in USD must be UTF-8 without line breaks and other control characters")


def check_stage(stage, path):
    """Checks the layers, the up axis, units, rates and times of a stage.

    Raises:
        ValueError: A sublayer is missing, the up axis is not Y or Z, a unit, rate or time is out of range, or the end is before
            the start.
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
            _refuse_outside(where, name, getattr(layer, name), -MAX_TIME_CODE, MAX_TIME_CODE)
    if stage.HasAuthoredTimeCodeRange() and stage.GetEndTimeCode() < stage.GetStartTimeCode():
        end, start = stage.GetEndTimeCode(), stage.GetStartTimeCode()
        raise ValueError(f"{path}: endTimeCode is {end:g}, must be at least startTimeCode, which is {start:g}")


def check_composed(prim, path):
    """Raises ValueError if a file to which a prim or an ancestor refers is missing."""
    for error in prim.GetStage().GetCompositionErrors():
        if prim.GetPath().HasPrefix(error.rootSite.path) or error.rootSite.path.HasPrefix(prim.GetPath()):
            raise ValueError(f"{path}, prim {prim.GetPath()}: {_plain(str(error))} It must be there")


def _refuse_outside(where, name, value, least, most):
    if not least <= value <= most:
        raise ValueError(f"{where}: {name} is {shown(value)}, must be a number of {least:g} to {most:g}")


def value_of(attribute, time=None):
    """Returns the value of an attribute at a time code or the default time, or None; refuses values that cannot be read."""
    try:
        with redirect_stderr(StringIO()):  # pxr prints a value that it cannot convert to Python
            return attribute.Get(Usd.TimeCode.Default() if time is None else time)
    except UnicodeDecodeError:
        raise ValueError(f"{attribute.GetName()} is no valid UTF-8") from None
    except (Tf.ErrorException, TypeError) as error:
        raise ValueError(f"{attribute.GetName()} cannot be read ({reason_of(error)})") from None


def token_of(attribute, allowed):
    """Returns the value of an attribute, which must be one of ``allowed``."""
    value = value_of(attribute)
    if value not in allowed:
        raise ValueError(f"{attribute.GetName()} is {shown(value)}, must be one of {', '.join(map(str, allowed))}")
    return value


def array_of(attribute, components=(), whole=False, time=None):
    """Returns the rows of an array attribute (count, *components), int32 if ``whole``; or None. Other rows are refused."""
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
    """Raises ValueError with the first of some numbers that is not an index below ``count``."""
    wrong = (numbers < 0) | (numbers >= count)
    if wrong.any():
        first = int(np.argmax(wrong))
        raise ValueError(f"{name}[{first}] = {numbers[first]}, must be a {what}, 0 to {count - 1}")


def refuse_unknown(name, values, where="", infinite=False):
    """Raises ValueError with the first number that is not finite, or with ``infinite`` NaN."""
    wrong = np.isnan(values) if infinite else ~np.isfinite(values)
    for entry in np.argwhere(wrong)[:1].tolist():
        index = "".join(f"[{i}]" for i in entry)
        raise ValueError(f"{name}{index}{where} is {values[tuple(entry)]}, must be {'a number' if infinite else 'finite'}")


def time_codes_of(attribute):
    """Lists the time codes of the samples of an attribute, up to `MAX_TIME_CODE`; refuses larger ones."""
    codes = attribute.GetTimeSamples()
    for code in codes:
        if not abs(code) <= MAX_TIME_CODE:
            raise ValueError(
                f"{attribute.GetName()} has a sample at time code {code:g}, must be at -{MAX_TIME_CODE:g} to {MAX_TIME_CODE:g}"
            )
    return codes
