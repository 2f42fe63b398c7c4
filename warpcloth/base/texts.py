"""Converts text to values and values to text, for the command line, for the axes of charts and for JSON."""

import inspect
import json
import math
import types
import typing
from dataclasses import fields
from functools import cache

import numpy as np

from .checks import did_you_mean, number

WORDS = {bool: "true or false", int: "a whole number", float: "a number, or a fraction such as 1/240", str: "a text"}
_TRUTH = dict.fromkeys(("true", "yes", "on", "1"), True) | dict.fromkeys(("false", "no", "off", "0"), False)


def parameters_of(function):
    """Returns the `inspect.Parameter` of each named parameter of a function or class, by name."""
    by_name = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
    found = inspect.signature(function, eval_str=True).parameters
    return {name: parameter for name, parameter in found.items() if parameter.kind in by_name}


def words_in(annotation):
    """Returns the words of the Literals in an annotation."""
    if typing.get_origin(annotation) is typing.Literal:
        return typing.get_args(annotation)
    return tuple(word for each in typing.get_args(annotation) for word in words_in(each))


@cache
def words_of(record):
    """Returns the allowed words of each field of a dataclass that is annotated as Literal, by name."""
    hints = typing.get_type_hints(record)
    return {name: typing.get_args(hint) for name, hint in hints.items() if typing.get_origin(hint) is typing.Literal}


def camel_case(name):
    """Returns a name in USD's style: ``area_ratio`` becomes ``areaRatio``."""
    first, *others = name.split("_")
    return first + "".join(word.capitalize() for word in others)


def numbered(labels, taken=()):
    """Returns the labels, each with a number appended if it occurred before or is ``taken``."""
    found = []
    for label in labels:
        name, number = label, 1
        while name in found or name in taken:
            number += 1
            name = f"{label} {number}"
        found.append(name)
    return found


def assignments(texts, option=None):
    """Returns a dict of strings from texts of the form ``name=value``, those of an option of the command line if one is given.

    Raises:
        ValueError: A text has another form, or a name occurs twice.
    """
    result = {}
    for text in texts:
        name, sign, value = text.partition("=")
        if not (name and sign):
            given, hint = (f"{option} {text!r}", "") if option else (repr(text), " (SCENE stands before -s and -p)")
            raise ValueError(f"{given} is not of the form name=value{hint}")
        if name in result:
            given = f"{option} {name}" if option else name
            raise ValueError(f"{given} is given twice, as {result[name]!r} and {value!r}")
        result[name] = value
    return result


def options(record, texts):
    """Converts text by name to arguments of the dataclass ``record``, by its annotations.

    Raises:
        ValueError: It has no such field, or the field does not take the value.
    """
    hints = typing.get_type_hints(record)
    kinds = {field.name: hints[field.name] for field in fields(record)}
    for name in texts:
        if name not in kinds:
            raise ValueError(f"{record.__name__} has no option {name!r}; {allowed(kinds, name)}")
    return {name: convert(name, text, _kinds(kinds[name])) for name, text in texts.items()}


def convert(name, text, kinds):
    """Converts ``text`` to the first of bool, int, float and str that is in ``kinds`` and accepts it.

    If ``kinds`` has the type of None, "none" gives None. A number is text that `float` accepts, or two such with a / between.

    Raises:
        ValueError: No type accepts it.
    """
    if type(None) in kinds and text.lower() == "none":
        return None
    converters = {bool: _truth, int: _whole, float: _number, str: str}
    known = [kind for kind in converters if kind in kinds]
    if not known:
        raise ValueError(f"{name} takes {' or '.join(kind.__name__ for kind in kinds)}, which cannot be written as text")
    for kind in known:
        try:
            return converters[kind](text)
        except (KeyError, ValueError, ZeroDivisionError, OverflowError):
            continue
    raise ValueError(f"{name} is {text!r}; it must be {' or '.join(WORDS[kind] for kind in known)}")


def fraction(name, text):
    """Returns the fraction that a text such as 1% or 0.01 gives.

    Raises:
        ValueError: It is not a number above 0, or is above 1, as a percentage without its sign would be.
    """
    value = convert(name, text.removesuffix("%"), (float,)) / (100.0 if text.endswith("%") else 1.0)
    number(name, value, above=0.0)
    if value > 1.0:
        raise ValueError(f"{name} is {text}, {value:g} times the whole; it must be no more than 100%, such as 1% or 0.01")
    return value


def milliseconds(name, text):
    """Returns the time [ms] that a text such as 16ms, 0.016s or 16 gives.

    Raises:
        ValueError: It is not a number above 0.
    """
    unit = next((unit for unit in ("ms", "s") if text.endswith(unit)), "")
    value = convert(name, text.removesuffix(unit).strip(), (float,)) * (1e3 if unit == "s" else 1.0)
    number(name, value, above=0.0)
    return value


def _truth(text):
    return _TRUTH[text.lower()]


def _whole(text):
    value = _number(text)
    if value != math.floor(value):
        raise ValueError
    return int(text) if text.strip().lstrip("+-").isdigit() else int(value)


def _number(text):
    above, sign, below = text.partition("/")
    value = float(above) / float(below) if sign else float(above)
    if math.isnan(value):
        raise ValueError
    return value


def _kinds(annotation):
    if typing.get_origin(annotation) in (typing.Union, types.UnionType):
        return tuple(kind for each in typing.get_args(annotation) for kind in _kinds(each))
    if typing.get_origin(annotation) is typing.Literal:
        return tuple({type(value): None for value in typing.get_args(annotation)})
    return (annotation if isinstance(annotation, type) else type(annotation),)


def kinds_of_parameter(parameter):
    """Returns the types of a parameter, from its annotation or else from its default."""
    if parameter.annotation is not parameter.empty:
        return _kinds(parameter.annotation)
    if parameter.default is None or parameter.default is parameter.empty:
        return (int, float, str, type(None))
    return (type(parameter.default),)


def allowed(names, given):
    """Returns the end of an error message that lists the allowed names, and the one that is closest to the ``given`` name."""
    return f"allowed are {', '.join(names)}{did_you_mean(given, names)}" if names else "it takes none"


def json_text(value, nan="nan", **options):
    """Returns ``value`` as JSON. Infinite numbers become the strings "inf" and "-inf", and NaN becomes ``nan``.

    Args:
        value: Dicts, lists, arrays, numbers and strings; of any other object, its string.
        nan: A string, or None for null.
        options: Those of `json.dumps`.
    """
    return json.dumps(_strict(value, nan), allow_nan=False, **options)


def _strict(value, nan):
    """Converts ``value`` to types that JSON has."""
    if isinstance(value, (np.ndarray, np.generic)):
        value = value.tolist()
    if isinstance(value, dict):
        return {key: _strict(item, nan) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_strict(item, nan) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return nan if math.isnan(value) else str(value)
    return value if isinstance(value, (bool, int, float, str, type(None))) else str(value)
