"""Old names of parameters: they work for one release, with a DeprecationWarning that gives the new name."""

import functools
import warnings
from collections.abc import Callable
from typing import Any, TypeVar

Record = TypeVar("Record")


def renamed(**names: str) -> Callable[[Record], Record]:
    """Decorates a record whose fields had other names: ``@renamed(stiffness="correction")`` takes and reads the old one too.

    The record keeps the names in ``renamed_fields``, new name by old name.
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
    """Returns the present name of a field of a record, with a warning if ``name`` is its old one."""
    new = getattr(record, "renamed_fields", {}).get(name, name)
    if new != name:
        warnings.warn(f"{record.__name__}: {name} is now called {new}", DeprecationWarning, stacklevel)
    return new
