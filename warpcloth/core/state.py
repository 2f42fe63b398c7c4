"""The state of a bound solver as a value: everything that one step passes to the next."""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
import warp as wp

from .status import Result


class Count(NamedTuple):
    """How the values of an array depend on the number of steps, for steps whose length changes.

    Attributes:
        sums: Whether each step adds a number to it, such as that of the moves that were cut short. Else it is the number of
            steps, or the note of a step.
        rest: Of a note FIRST − (step·rest + other), with 0 for none: the number of values of ``other``. Else 0.
    """

    sums: bool = False
    rest: int = 0


class State:
    """Every array that one step passes to the next, and the results of the steps so far.

    A stepper registers further arrays with :meth:`add`, such as the position residual of compensated summation or the move of
    the last step. Code that copies, compares, resets or stores a state does not know them by name. Arrays that a step writes
    before it reads them do not belong to the state.

    Args:
        x: Positions (N,) vectors [m].
        v: Velocities (N,) vectors [m/s].
        batch_size: Number of copies of the scene, B.
        shares: States of the parts of the batch that threads have, whose x and v are views of those of this state.

    Attributes:
        arrays: All arrays on the device by name, with N or B rows, ``"x"`` and ``"v"`` among them.
        parts: Objects with values of other sizes by name, see :meth:`add_part`; a reset does not change them.
        starts: Initial values by name, for arrays that start neither at 0 nor from the model.
        results: The worst :class:`warpcloth.core.status.Result` of each copy so far, a list of B.
        residual: The largest residual of each copy so far, (B,).
        counts: Arrays that count steps, by name: a :class:`Count` of each.
    """

    def __init__(self, x, v, batch_size, shares=()):
        self.arrays, self.starts, self.shares, self.parts = {"x": x, "v": v}, {}, tuple(shares), {}
        self.counts = {}
        self._results, self._residual = [Result.COMPLETED] * batch_size, np.zeros(batch_size)

    @property
    def results(self):
        """The worst result of each copy so far."""
        return [result for share in self.shares for result in share.results] if self.shares else self._results

    @results.setter
    def results(self, results):
        self._results = results

    @property
    def residual(self):
        """The largest residual of each copy so far, (B,)."""
        return np.concatenate([share.residual for share in self.shares]) if self.shares else self._residual

    @residual.setter
    def residual(self, residual):
        self._residual = residual

    @property
    def x(self):
        """Positions (N,) vectors [m]."""
        return self.arrays["x"]

    @property
    def v(self):
        """Velocities (N,) vectors [m/s]."""
        return self.arrays["v"]

    def __iter__(self):
        """x and v, for ``x, v = stepper.state``."""
        return iter((self.x, self.v))

    def add(self, name, array, count=None):
        """Registers an array that is 0 at the start, and returns it; ignores None.

        Args:
            name: Its name.
            array: The array, or None.
            count: The :class:`Count` of an array whose values depend on the number of steps, or None.
        """
        if array is not None:
            self.arrays[name] = array
            if count is not None:
                self.counts[name] = count
        return array

    def add_part(self, name, part):
        """Registers a value with the methods ``copy``, ``assign``, ``to_host`` and ``from_host``, and returns it."""
        self.parts[name] = part
        return part

    def start_here(self, *names):
        """Makes the present values of these arrays their initial values."""
        self.starts |= {name: wp.clone(self.arrays[name]) for name in names}

    def copy(self, motion=None):
        """Returns an equal state with arrays of its own, or with ``motion`` for its x and v, which have the same values."""
        x, v = motion or (wp.clone(self.x), wp.clone(self.v))
        ends = np.cumsum([0, *(len(share.x) for share in self.shares)]).tolist()
        parts = zip(self.shares, pairwise(ends), strict=True)
        shares = [share.copy((x[first:end], v[first:end])) for share, (first, end) in parts]
        other = State(x, v, len(self.results), shares)
        other.arrays |= {name: wp.clone(array) for name, array in self.arrays.items() if name not in other.arrays}
        other.parts = {name: part.copy() for name, part in self.parts.items()}
        other.starts, other.results, other.residual = self.starts, list(self.results), self.residual.copy()
        other.counts = self.counts
        return other

    def assign(self, other):
        """Copies the values of another state of the same solver and model into the arrays of this one.

        Arrays and parts that were added to this one after the other was copied from it keep their values.
        """
        for share, of_other in zip(self.shares, other.shares, strict=True):
            share.assign(of_other)
        for name in filter(other.arrays.__contains__, self.arrays):  # after the shares, whose x and v are parts of these
            wp.copy(self.arrays[name], other.arrays[name])
        for name in filter(other.parts.__contains__, self.parts):
            self.parts[name].assign(other.parts[name])
        self.results, self.residual = list(other.results), other.residual.copy()

    def __eq__(self, other):
        """Returns whether all bits are equal, so that NaN equals NaN."""
        if not isinstance(other, State):
            return NotImplemented
        mine, of_other = self.to_host(), other.to_host()
        return mine.keys() == of_other.keys() and all(
            values.dtype == of_other[name].dtype and values.tobytes() == of_other[name].tobytes()
            for name, values in mine.items()
        )

    __hash__ = None

    def to_host(self):
        """Returns copies of everything as NumPy arrays by name."""
        found = {name: np.array(array.numpy()) for name, array in self.arrays.items()}
        found |= {"results": np.array([result.name for result in self.results]), "residual": np.array(self.residual)}
        for name, part in self.parts.items():
            found |= {f"{name} {key}": values for key, values in part.to_host().items()}
        for k, share in enumerate(self.shares):
            found |= {f"share {k} {name}": values for name, values in share.to_host().items() if name not in ("x", "v")}
        return found

    def from_host(self, values):
        """Sets everything to the values that :meth:`to_host` returned for an equal scene and solver.

        Raises:
            ValueError: They are of another scene or solver.
        """
        now = self.to_host()
        sized = [name for name in now if not any(name.startswith(f"{part} ") for part in self.parts)]
        if now.keys() != values.keys() or any(now[name].shape != values[name].shape for name in sized):
            raise ValueError("the state is of another scene or solver")
        for name, array in self.arrays.items():
            array.assign(values[name])
        for name, part in self.parts.items():
            part.from_host({key: values[f"{name} {key}"] for key in part.to_host()})
        self.results, self.residual = [Result[name] for name in values["results"]], np.array(values["residual"])
        for k, share in enumerate(self.shares):
            own = {name: values.get(f"share {k} {name}", array) for name, array in share.to_host().items()}
            share.from_host(own)
