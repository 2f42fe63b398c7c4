"""The dynamic elements of a model, whose number changes on the device: their sums and sweeps."""

from functools import partial

import warp as wp


class Dynamic:
    """Some dynamic elements of a model, in the order of sweeps; or none, with which methods launch nothing.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        terms: :class:`warpcloth.core.dynamic_elements.DynamicElements`.

    Attributes:
        terms: As given.
    """

    def __init__(self, model, terms):
        self.model, self.terms = model, tuple(terms)
        self._energies = wp.zeros(model.count if terms else 0, dtype=wp.float64, device=model.device)

    def __len__(self):
        return len(self.terms)

    def _launch_each(self, name, *given, order=1):
        for each in self.terms[::order]:
            wp.capture_if(each.present, partial(getattr(each, name), *given))

    def launch(self, x, correction=None):
        """Launches the forces at x, or at x + correction. The methods below sum them."""
        self._launch_each("launch", x, correction)

    def add_gradient(self, out):
        """out (N,) += ∂U/∂x."""
        self._launch_each("add_gradient", out)

    def add_energy(self, sums, out, stored=False):
        """out (B,) += U, or the part of it that is ``stored`` in the state."""
        terms = [each for each in self.terms if each.stored or not stored]

        def add():
            self._energies.zero_()
            for each in terms:
                wp.capture_if(each.present, partial(each.add_energies, self._energies))
            sums.sum(self._energies, self.model.per_copy, out, accumulate=1)

        self.when_present(add, terms)

    def when_present(self, launch, terms=None):
        """Calls ``launch`` if there may be elements of any of ``terms``, or of all."""
        terms = self.terms if terms is None else terms
        if terms:
            wp.capture_if(terms[0].present, launch, partial(self.when_present, launch, terms[1:]))

    def add_diagonal(self, diagonal, values, policy):
        """Adds to the diagonal blocks of a :class:`warpcloth.core.hessian.Hessian` with this ``policy`` (B,)."""
        self._launch_each("add_diagonal", diagonal, values, policy)

    def add_products(self, p, q, active):
        """q += A p for the off-diagonal blocks A, in ``active`` copies (B,)."""
        self._launch_each("add_products", p, q, active)
        if self.terms:
            self.model.lock(q)

    @property
    def terms_in_rows(self):
        """The number of terms, if their sums gather and :meth:`set_pairs` has room for them; else 0."""
        gathered = not any(each.scatters for each in self.terms) and len(self.terms) <= 2
        return len(self.terms) if gathered else 0

    def set_pairs(self, rows):
        """Sets the pairs in a :func:`warpcloth.kernels.block_rows.block_rows`."""
        model, names = self.model, (("pairs", "blocks"), ("other_pairs", "other_blocks"))
        if model.mobility is not None:
            rows.mobility = model.mobility
        for each, (pairs, blocks) in zip(self.terms, names, strict=False):
            setattr(rows, pairs, each.pairs)
            setattr(rows, blocks, each.blocks)

    def sweeps(self, in_turn):
        """Prepares sweeps: Gauss–Seidel (``in_turn``), or Jacobi for devices with many threads."""
        for each in self.terms:
            each.sweeps(in_turn)

    def launch_sweep_start(self, x):
        """Launches λ = 0 before the first sweep, at x̃ (N,)."""
        self._launch_each("launch_sweep_start", x)

    def launch_sweep(self, x, correction, h, adds, backward=False, follows=True):
        """Launches a sweep over all elements.

        Args:
            x: x̃ (N,) [m].
            correction: d (N,) [m].
            h: Step [s].
            adds: Whether multipliers accumulate over sweeps; else elements are hard.
            backward: Whether a Gauss–Seidel sweep goes from the last element to the first.
            follows: Whether it counts among the sweeps after which elements are found anew.
        """
        self._launch_each("launch_sweep", x, correction, h, adds, backward, follows, order=-1 if backward else 1)


def dynamic_of(model, terms=None, dynamic=()):
    """Returns the :class:`Dynamic` elements of a model, or those given with ``terms``."""
    return Dynamic(model, model.dynamic if terms is None else dynamic)
