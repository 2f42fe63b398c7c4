"""Names of a package that are imported when they are first used, and catalogues of records by name."""

from collections.abc import Callable, Iterator, Mapping, MutableMapping
from importlib import import_module
from typing import Any


def imported_on_use(package: str, modules: Mapping[str, str]) -> Callable[[str], Any]:
    """Returns the ``__getattr__`` of a package that imports a name from its module in the package when it is used.

    Args:
        package: Name of the package.
        modules: The module of each name.
    """

    def find(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(f"{package}.{modules[name]}"), name)

    return find


class Catalogue(MutableMapping[str, Any]):
    """Records by name. The package imports its own when they are looked up; the names alone import nothing.

    Args:
        package: Name of the package.
        records: The name of each record in the package.
    """

    def __init__(self, package: str, records: Mapping[str, str]) -> None:
        self._package, self._records = package, dict[str, Any](records)

    def __getitem__(self, name: str) -> Any:
        record = self._records[name]
        return getattr(import_module(self._package), record) if isinstance(record, str) else record

    def __setitem__(self, name: str, record: Any) -> None:
        self._records[name] = record

    def __delitem__(self, name: str) -> None:
        del self._records[name]

    def __contains__(self, name: object) -> bool:
        return name in self._records

    def __iter__(self) -> Iterator[str]:
        return iter(self._records)

    def __len__(self) -> int:
        return len(self._records)
