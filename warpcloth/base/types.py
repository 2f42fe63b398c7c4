"""Types that annotations share. Shapes and units of arrays are in the docstrings."""

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
    """Annotates a field of a record that takes one type and keeps another: ``gravity: Converted[ArrayLike, np.ndarray]``.

    It is for type checkers, which read it as a descriptor; nothing of it is there when the program runs.
    """

    if TYPE_CHECKING:

        def __get__(self, record: object, owner: type | None = None) -> Kept: ...

        def __set__(self, record: object, value: Taken) -> None: ...


def default(value: object) -> Any:
    """Returns the default of a field that is annotated as `Converted`; ``dataclasses.MISSING`` for one that must be given.

    Type checkers take a field for a descriptor only where it has a default.
    """
    return value
