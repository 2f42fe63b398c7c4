"""Steps are taken again if the filters of contact have added energy in them."""

import numpy as np
import warp as wp

from ..core.capture import Mirror, Segment
from ..core.energy import Energy
from ..core.sums import Sums
from ..kernels import assemble
from ..kernels.contact.retakes import correct_to
from ..kernels.terms.air import AIR
from ..model.host_values import host_values


class Retakes:
    """Takes a step again in copies in which the filters cut moves.

    A filter cuts moves of neighbouring vertices by different fractions, which strains the cloth. A step in which it cut a move
    may end with at most the energy of its start. The start has the pins of the end, so that the work of pins and colliders is
    in its energy, and the potential of gravity and dead loads counts. Otherwise the step is taken again

    - with self-contact, wherever that filter cut a move, from a prediction that does not cross the cloth (an inelastic impact,
      see :meth:`warpcloth.contact.self_filter.SelfFilter.launch_impact`), so that all pairs are known where it begins;
    - then, until the energy does not rise, at positions to which neighbours of cut vertices follow: the cut of the nearest such
      vertex is added to the solution times 1 − distance/R, R = 2, 4, … edges. Where R exceeds the piece and the energy still
      rises, the whole move of the piece is halved, again and again.

    Args:
        stepper: The :class:`warpcloth.solvers.solver.Stepper`, with an integrator.

    Attributes:
        again: In which copies the prediction must not cross the cloth, (B,) int32.
        some: Whether that is so in any copy, (1,) int32.
    """

    def __init__(self, stepper):
        from scipy.sparse import csr_matrix
        from scipy.sparse.csgraph import connected_components

        model = stepper.model
        self._stepper, self._sums = stepper, Sums(model)
        arrays = [] if stepper.colliders is None else [stepper.colliders.notes.cut]
        arrays += [] if stepper.pairs is None else [stepper.pairs.cut]
        self._counts = [Mirror(array) for array in arrays]
        self._again, self._some = Mirror(model.scalars(wp.int32)), Mirror(wp.zeros(1, dtype=wp.int32, device=model.device))
        self.again, self.some = self._again.array, self._some.array
        self._free = model.coordinate_mobility().reshape(-1, 3) > 0.0
        self._mass = np.where(self._free, model.mass.numpy().astype(np.float64)[:, None], 0.0)
        self._energy, self._room, self._resolved = None, -1, np.sqrt(np.finfo(model.numpy_dtype).eps)
        self._target, self._of_copies = model.vectors(), Mirror(model.scalars(wp.int32))
        self._correct = model.kernel(correct_to, model.dtype)
        edges = model.in_model(model.scene.mesh.edges).T
        self._edges = csr_matrix((np.ones(edges.shape[1]), edges), shape=(model.per_copy,) * 2)
        self._pieces = connected_components(self._edges, directed=False)[1]

    def begin(self):
        """Notes the number of cuts before a step."""
        self._before = [count.read().copy() for count in self._counts]

    @property
    def cut(self):
        """In which copies a filter has cut a move since :meth:`begin`, (B,)."""
        return np.any([count.read() > before for count, before in zip(self._counts, self._before, strict=True)], axis=0)

    def settle(self, kept, take):
        """Takes a step again where it must be.

        Args:
            kept: The :class:`warpcloth.core.state.State` before the step.
            take: Function that takes the step.
        """
        stepper, cut = self._stepper, self._moved()
        rose = self.cut & self._rose(kept)
        # A pin that other pins hold back along a locked axis does not move free coordinates.
        again = rose | ((self._counts[-1].read() > self._before[-1]) & cut.any(axis=1))
        if stepper.pairs is not None and again.any():
            stepper.state.assign(kept)
            self._again.write(again)
            self._some.write(1)
            take()
            self._some.write(0)
            rose = (rose | again) & self._rose(kept)
        if rose.any():
            self._spread(kept, rose, cut)

    def _rose(self, kept):
        """Returns in which copies the energy at the end is above that at the start, by more than rounding, (B,)."""
        end = [array.numpy().astype(np.float64) for array in self._stepper.state]
        x, v = (array.numpy().astype(np.float64) for array in kept)
        x = np.where(self._free, x, end[0])
        model = self._stepper.model
        gravity, each = model.free_gravity
        weight = self._mass * np.repeat(gravity.numpy().astype(np.float64), each, axis=0)
        start = self._stored(x) + self._summed(0.5 * self._mass * v**2)
        more = self._stored(end[0]) + self._summed(0.5 * self._mass * end[1] ** 2 - weight * (end[0] - x)) - start
        return more > self._resolved * start

    def _summed(self, values):
        return values.reshape(self._stepper.model.copies, -1).sum(axis=1)

    def _stored(self, x):
        """Returns the energy of elements, and of contact with the areas at x (N, 3), (B,) [J]."""
        stepper, pairs, model = self._stepper, self._stepper.pairs, self._stepper.model
        if self._energy is None:
            soft = [elements for elements in stepper.declared.terms if elements.collider is None and not elements.hard]
            self._energy = Energy(model, self._sums, terms=[elements for elements in soft if elements.term is not AIR])
            self._touching = [elements for elements in model.terms if elements.collider is not None and not elements.hard]
            self._x, self._found = model.vectors(), model.scalars()
        self._x.assign(x)
        self._found.zero_()
        self._energy.add(self._x, self._found)
        if pairs is not None:
            pairs.launch_areas(self._x)
            pairs.forces.launch(self._x)
            pairs.forces.add_energy(self._sums, self._found)
        return self._found.numpy() + sum(map(self._stored_by, self._touching), np.zeros(model.copies))

    def _stored_by(self, elements):
        """Returns the energy of contact elements, which sweeps do not sort by copies, (B,) [J]."""
        model = self._stepper.model
        values = wp.zeros(elements.count, dtype=wp.float64, device=model.device)
        kernel = model.kernel(assemble.energy, elements.term, model.dtype, False, False)
        model.launch(kernel, elements.count, [*elements.arguments, self._x, None, None], [values])
        copies = host_values(elements.stencil).reshape(elements.count, -1)[:, 0] // model.per_copy
        return np.bincount(copies, values.numpy(), model.copies)

    def _spread(self, kept, rose, stuck):
        """Ends the step elsewhere: with cuts spread over more and more vertices, then with shorter and shorter moves.

        Pieces with ``stuck`` vertices (B, n) make the shorter moves, and those that are cut here.
        """
        stepper, shape = self._stepper, (*self._moved().shape, 3)
        start, solved, end = (
            array.numpy().astype(np.float64).reshape(shape) for array in (kept.x, stepper.unfiltered, stepper.state.x)
        )
        results, residual = list(stepper.state.results), stepper.state.residual.copy()
        cut, target, radius, part = self._moved(), end.copy(), 2.0, np.ones(shape[0])
        spread, found = rose, {copy: self._from_cuts(cut[copy]) for copy in np.flatnonzero(rose)}
        stuck = stuck | cut
        while rose.any():
            for copy in np.flatnonzero(rose):
                distances, sources = found[copy]
                near = np.isfinite(distances)
                if radius < 2.0 * distances[near].max(initial=0.0):
                    weight = np.maximum(1.0 - distances[near, None] / radius, 0.0)
                    target[copy, near] = solved[copy, near] + weight * (end - solved)[copy, sources[near]]
                else:
                    part[copy] = 0.5 * part[copy] if part[copy] > self._resolved else 0.0
                    near = np.isin(self._pieces, self._pieces[stuck[copy]])
                    target[copy, near] = start[copy, near] + part[copy] * (end - start)[copy, near]
            self._target.assign((start + (target - start) / stepper.integrator.parts).reshape(-1, 3))
            self._of_copies.write(rose)
            stepper.state.assign(kept)
            stepper.take_all(self._end)
            stepper.state.results, stepper.state.residual = results, residual
            stuck |= self._moved()
            rose = rose & (part > 0.0) & self._rose(kept)
            radius *= 2.0
        elsewhere = (target != solved).any(axis=2) & self._free.any(axis=1).reshape(shape[:2]) & ~self._moved()
        elsewhere[~spread] = False
        self._counts[-1].write(self._counts[-1].read() + elsewhere.sum(axis=1))

    def _from_cuts(self, cut):
        """Returns the number of edges from each vertex to the nearest that was ``cut`` (n,), and that vertex, both (n,)."""
        from scipy.sparse.csgraph import dijkstra

        if not cut.any():
            return np.full(len(cut), np.inf), None
        given = {"directed": False, "unweighted": True, "min_only": True, "return_predecessors": True}
        distances, _, sources = dijkstra(self._edges, indices=np.flatnonzero(cut), **given)
        return distances, sources

    def _end(self):
        """Ends the step at the target, as far as the filters let it."""
        pairs = self._stepper.pairs
        room = 0 if pairs is None else len(pairs.pairs.stencils)
        if self._room != room:
            self._ending, self._room = Segment(self._stepper.model.device, self._launch_end), room
        self._ending()

    def _moved(self):
        """Returns which free vertices the filters moved in the last step, (B, n)."""
        stepper = self._stepper
        moved = (stepper.unfiltered.numpy() != stepper.state.x.numpy()) & self._free
        return moved.any(axis=1).reshape(stepper.model.copies, -1)

    def _launch_end(self):
        stepper, model = self._stepper, self._stepper.model
        stepper.launch_prediction()
        given = [model.inverse_mass, model.mobility, self._target, stepper.state.x, self._of_copies.array, model.per_copy]
        model.launch(self._correct, model.count, given, [stepper.correction])
        stepper.launch_finish(stepper.correction)
