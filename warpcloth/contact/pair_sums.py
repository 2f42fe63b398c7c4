"""The sums of energies, forces and Hessians of pairs, over the vertices of a model."""

from ..kernels.contact import pair_sums

GATHERS = (
    pair_sums.gather_pair_forces,
    pair_sums.gather_pair_energies,
    pair_sums.gather_pair_diagonal,
    pair_sums.gather_pair_products,
)
SCATTERS = (
    pair_sums.scatter_pair_forces,
    pair_sums.scatter_pair_energies,
    pair_sums.scatter_pair_diagonal,
    pair_sums.scatter_pair_products,
)


class PairSums:
    """The base class of what has pairs with forces, which are gathered by vertices or scattered by one thread.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        source: The :class:`warpcloth.kernels.contact.pair_sums.PairSource` of the pairs.
        scatters: Whether they are scattered, for the CPU.

    Attributes:
        pairs: :func:`warpcloth.kernels.contact.self_pairs.near_pairs`.
        found: The ``data`` of the source.
    """

    def __init__(self, model, source, scatters):
        self.model, self._sums_over = model, 1 if scatters else model.count
        made = SCATTERS if scatters else GATHERS
        self._forces, self._energies, self._diagonal, self._products = (
            model.kernel(factory, source, model.dtype) for factory in made
        )

    def add_gradient(self, out):
        """out (N,) += ∂U/∂x."""
        self.model.launch(self._forces, self._sums_over, [self.pairs, self.found], [out])

    def add_energies(self, out):
        """Adds the energies of the pairs to those of their first vertices, (N,) [J]."""
        self.model.launch(self._energies, self._sums_over, [self.pairs, self.found], [out])

    def add_diagonal(self, diagonal, values):
        """Adds to the diagonal blocks of a :class:`warpcloth.core.hessian.Hessian`."""
        given = [self.pairs, self.model.inverse_mass, diagonal, self.found]
        self.model.launch(self._diagonal, self._sums_over, given, [values])

    def add_products(self, p, q, active):
        """q += A p for the off-diagonal blocks A, in ``active`` copies (B,)."""
        given = [self.pairs, self.model.inverse_mass, self.found, p, active, self.model.per_copy]
        self.model.launch(self._products, self._sums_over, given, [q])
