"""Types for annotations. Docstrings give the shapes and units of arrays."""

from collections.abc import Callable
from os import PathLike
from typing import TYPE_CHECKING, Any, Generic, Literal, TypeVar

Precision = Literal["float32", "float64"]
UpAxis = Literal["Y", "Z"]
FilePath = str | PathLike[str]
Progress = Callable[[int, int], object]

Taken = TypeVar("Taken")
Kept = TypeVar("Kept")
Call = TypeVar("Call", bound=Callable)


class Converted(Generic[Taken, Kept]):
    """Annotates a field that is given as one type and kept as another: ``gravity: Converted[ArrayLike, np.ndarray]``.

    Type checkers read it as a descriptor. It does nothing at run time.
    """

    if TYPE_CHECKING:

        def __get__(self, record: object, owner: type | None = None) -> Kept: ...

        def __set__(self, record: object, value: Taken) -> None: ...


def default(value: object) -> Any:
    """Returns the default of a `Converted` field; ``dataclasses.MISSING`` makes it a required field.

    Type checkers treat a field as a descriptor only if it has a default.
    """
    return value
