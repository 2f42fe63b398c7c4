"""Old names of parameters, which work for one more release, with a DeprecationWarning that gives the new name."""

import functools
import warnings
from collections.abc import Callable
from typing import Any, TypeVar

Record = TypeVar("Record")


def renamed(**names: str) -> Callable[[Record], Record]:
    """Decorates a dataclass with renamed fields: ``@renamed(stiffness="correction")`` accepts and reads ``stiffness`` too.

    The class keeps the dict from old to new names as ``renamed_fields``.
    """

    def decorate(record: Any) -> Any:
        make = record.__init__

        @functools.wraps(make)
        def with_old_names(self, *values, **options):
            for old in names.keys() & options.keys():
                options[new_name(record, old)] = options.pop(old)
            make(self, *values, **options)

        record.renamed_fields = names
        record.__init__ = with_old_names
        for old in names:
            setattr(record, old, property(functools.partial(_read, old)))
        return record

    return decorate


def _read(old: str, record: object) -> Any:
    return getattr(record, new_name(type(record), old))


def new_name(record: Any, name: str, stacklevel: int = 3) -> str:
    """Returns the present name of a field, and warns if ``name`` is its old name."""
    new = getattr(record, "renamed_fields", {}).get(name, name)
    if new != name:
        warnings.warn(f"{record.__name__}: {name} is now called {new}", DeprecationWarning, stacklevel)
    return new
