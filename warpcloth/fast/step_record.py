"""The record of how explicit steps are taken."""

from typing import NamedTuple


class StepRecord(NamedTuple):
    """How explicit steps are taken.

    Attributes:
        backend: ``"core"``, ``"blocks"`` or ``"gather"``.
        threads: Threads of the CPU that share the steps of one cloth.
        lanes: Threads of a GPU that take one vertex.
        block: Threads of the block that takes a copy through several steps in one launch, or 0.
        pairs: Labels of the quadratic terms that are taken by the entries of their matrix.
        compensated: Whether x is moved on by compensated summation.
        packed: Whether its residual is packed into four bytes.
    """

    backend: str
    threads: int = 1
    lanes: int = 1
    block: int = 0
    pairs: tuple[str, ...] = ()
    compensated: bool = False
    packed: bool = False
