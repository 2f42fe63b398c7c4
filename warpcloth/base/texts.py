"""Values that are written as texts, on the command line and in axes of charts: numbers, words and ``name=value``."""

import inspect
import json
import math
import types
import typing
from dataclasses import fields
from functools import cache

import numpy as np

from .checks import number
from .renamed import new_name

WORDS = {bool: "true or false", int: "a whole number", float: "a number, or a fraction such as 1/240", str: "a text"}
_TRUTH = dict.fromkeys(("true", "yes", "on", "1"), True) | dict.fromkeys(("false", "no", "off", "0"), False)


def parameters_of(function):
    """Returns the `inspect.Parameter` of each parameter of a function, or of a record of options, by name."""
    by_name = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
    found = inspect.signature(function, eval_str=True).parameters
    return {name: parameter for name, parameter in found.items() if parameter.kind in by_name}


@cache
def words_of(record):
    """Returns the words of the options of a record that take nothing but words, by name: those annotated as Literal."""
    hints = typing.get_type_hints(record)
    return {name: typing.get_args(hint) for name, hint in hints.items() if typing.get_origin(hint) is typing.Literal}


def camel_case(name):
    """A name as USD has it: ``stretch_1`` is ``stretch1``, ``area_ratio`` is ``areaRatio``."""
    first, *others = name.split("_")
    return first + "".join(word.capitalize() for word in others)


def numbered(labels, taken=()):
    """The labels, numbered where one occurs twice or is taken."""
    found = []
    for label in labels:
        name, number = label, 1
        while name in found or name in taken:
            number += 1
            name = f"{label} {number}"
        found.append(name)
    return found


def assignments(texts):
    """A dict from texts of the form ``name=value``.

    Raises:
        ValueError: A text of another form, or a name that stands twice.
    """
    result = {}
    for text in texts:
        name, sign, value = text.partition("=")
        if not (name and sign):
            raise ValueError(f"{text!r} is not of the form name=value (SCENE stands before -s and -p)")
        if name in result:
            raise ValueError(f"{name} is given twice, as {result[name]!r} and {value!r}")
        result[name] = value
    return result


def options(record, texts):
    """Arguments for the dataclass ``record`` from text by name, converted by its annotations.

    Raises:
        ValueError: A name or a value that it does not take.
    """
    hints = typing.get_type_hints(record)
    kinds = {field.name: hints[field.name] for field in fields(record)}
    texts = {new_name(record, name, stacklevel=1): text for name, text in texts.items()}
    for name in texts:
        if name not in kinds:
            raise ValueError(f"{record.__name__} has no option {name!r}; {allowed(kinds)}")
    return {name: convert(name, text, _kinds(kinds[name])) for name, text in texts.items()}


def convert(name, text, kinds):
    """``text`` as the first of bool, int, float, str that is in ``kinds`` and takes it; "none" where None is.

    Nothing is evaluated: a number is what `float` takes, or two of these with a / between them.

    Raises:
        ValueError: If none takes it.
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
    """A share of the whole, written as 1% or 0.01; above 1 it is refused, as a percentage without its sign."""
    value = convert(name, text.removesuffix("%"), (float,)) / (100.0 if text.endswith("%") else 1.0)
    number(name, value, above=0.0)
    if value > 1.0:
        raise ValueError(f"{name} is {text}, {value:g} times the whole; it must be no more than 100%, such as 1% or 0.01")
    return value


def milliseconds(name, text):
    """A time in ms, written as 16ms, 0.016s or 16."""
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
    """Returns the types that a parameter takes: those of its annotation, or else that of its default."""
    if parameter.annotation is not parameter.empty:
        return _kinds(parameter.annotation)
    if parameter.default is None or parameter.default is parameter.empty:
        return (int, float, str, type(None))
    return (type(parameter.default),)


def allowed(names):
    return f"allowed are {', '.join(names)}" if names else "it takes none"


def json_text(value, nan="nan", **options):
    """Returns ``value`` as JSON, with infinite numbers, which JSON does not have, as "inf" and "-inf", and NaN as ``nan``.

    Args:
        value: Dictionaries, lists, arrays, numbers and texts; anything else is written as its text.
        nan: None to write null.
        options: As of `json.dumps`.
    """
    return json.dumps(_strict(value, nan), allow_nan=False, **options)


def _strict(value, nan):
    """``value`` in types that JSON has."""
    if isinstance(value, (np.ndarray, np.generic)):
        value = value.tolist()
    if isinstance(value, dict):
        return {key: _strict(item, nan) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_strict(item, nan) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return nan if math.isnan(value) else str(value)
    return value if isinstance(value, (bool, int, float, str, type(None))) else str(value)
