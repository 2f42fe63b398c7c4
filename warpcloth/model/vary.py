"""Values that differ between the copies of a model: numeric fields of the scene, its terms and its loads."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ..base.checks import array, numeric, shown


class Vary:
    """The values of ``vary``, which are taken by name. :meth:`refuse_rest` checks that all were taken.

    Args:
        values: Arrays by name, with B entries each, see :class:`warpcloth.model.model.Model`.
        copies: B.

    Raises:
        ValueError: ``values`` is not a mapping.
    """

    def __init__(self, values, copies):
        if not isinstance(values, Mapping):
            raise ValueError(f"vary is {shown(values)}; it must be a dict of names and arrays, such as {{'gravity': …}}")
        self.values, self.copies, self.taken, self.fields = dict(values), copies, set(), []

    def has(self, name):
        """Whether a name is given."""
        return name in self.values

    def take(self, name, default):
        """Returns ``values[name]``, (B, *shape of default), or the default B times, with stride 0."""
        if name not in self.values:
            return self._repeated(np.asarray(default, dtype=np.float64))
        self.taken.add(name)
        return array(f"vary[{name!r}]", self.values[name], (self.copies, *np.shape(default))).copy()

    def _repeated(self, values):
        return np.broadcast_to(values, (self.copies, *np.shape(values)))

    def masses(self, scene):
        """Returns the masses of all copies, (B, n) [kg], and checks them."""
        if self.has("density") and self.has("masses"):
            raise ValueError("vary has density and masses; at most one of the two may be given")
        if self.has("density") and scene.density is None:
            raise ValueError("vary['density'] needs a scene with a density, and this one has masses; vary['masses'] instead")
        masses = self.take("masses", scene.vertex_masses)
        if self.has("density"):
            density = self.take("density", np.float64(scene.density))
            for copy in np.flatnonzero(~(density > 0.0)):
                raise ValueError(f"vary['density'] is {density[copy]} in copy {copy}; it must be above 0")
            masses = masses * (density / scene.density)[:, None]
        given = unlike_copies(masses)
        allowed = given > 0.0
        allowed[:, scene.fixed] |= given[:, scene.fixed] == 0.0
        for copy, vertex in np.argwhere(~allowed)[:1]:
            raise ValueError(
                f"vary['masses'] of vertex {vertex} is {masses[copy, vertex]} kg in copy {copy}; it must be above 0, "
                "of a pinned vertex 0 or more"
            )
        return masses

    def elements(self, term, mesh, positions):
        """Returns the elements of a term, and their values in each copy.

        Args:
            term: A :class:`warpcloth.terms.declared.Declared`.
            mesh: The :class:`warpcloth.Mesh`.
            positions: Initial positions of each copy, (B, n, 3) [m].

        Returns:
            (elements, rest, stiffness, damping): :class:`warpcloth.terms.declared.Elements` of the first copy, with weights
            (B, E, M) if they vary; rest states (B, E, P); stiffness and damping (B, 1), (B, E), or for cells (B, C).
        """
        one = term.elements(mesh, positions[0])
        count = len(one.stencil) if one.cells is None else len(one.cells) - 1
        given = {name: self._of_term(term, name, count) for name in term.quantities()}
        given = {name: values for name, values in given.items() if values is not None}
        found = [given.pop(name, None) for name in ("stiffness", "damping")]
        stiffness, damping = (
            self._repeated(np.atleast_1d(default)) if values is None else values.reshape(self.copies, -1)
            for values, default in zip(found, (one.stiffness, one.damping), strict=True)
        )
        if damping.any() and one.term.dissipation is None:
            raise ValueError(f"{one.label} cannot be damped; leave its damping out")
        if damping.any() and one.refresh:  # damping would overwrite the rest states
            raise ValueError(f"{one.label} changes during a run and cannot be damped; leave its damping out")
        if not (given or self.has("positions")):
            return one, self._repeated(one.rest), stiffness, damping
        found = []
        for copy in range(self.copies):
            try:
                declared = replace(term, **{name: values[copy] for name, values in given.items()})
                found.append(declared.elements(mesh, positions[copy]))
            except ValueError as error:
                raise ValueError(f"{error}, in copy {copy}") from error
        if one.weights is not None:
            one = replace(one, weights=np.stack([each.weights for each in found]))
        return one, np.stack([each.rest for each in found]), stiffness, damping

    def _of_term(self, term, field, count):
        """Returns a field of a term, (B, *shape) or (B, count, *shape), or None if it does not vary."""
        quantity = term.quantities()[field]
        self.fields.append(f"{type(term).__name__}.{field}")
        for name in (f"{term.label}.{field}", f"{type(term).__name__}.{field}"):
            if name in self.values:
                self.taken.add(name)
                one, each = (self.copies, *quantity.shape), (self.copies, count, *quantity.shape)
                values = numeric(f"vary[{name!r}]", self.values[name], f"have shape {one} or {each}")
                if values.shape not in (one, each):
                    raise ValueError(f"vary[{name!r}] has shape {values.shape}; it must be {one} or {each}")
                for copy, *index in np.argwhere(~quantity.holds(values))[:1].tolist():
                    value = values[(copy, *index)]
                    raise ValueError(f"{term.label}.{field} is {value} in copy {copy}; it {quantity.rule}")
                return values
        return None

    def load(self, load):
        """Returns the load of each copy, a list of B records."""
        found = [load] * self.copies
        for field in (load.quantity, "keyframes"):
            self.fields.append(f"{type(load).__name__}.{field}")
            name = next((f"{of}.{field}" for of in (load.label, type(load).__name__) if f"{of}.{field}" in self.values), None)
            if name is None:
                continue
            self.taken.add(name)
            values = numeric(f"vary[{name!r}]", self.values[name], "have an entry for each copy")
            if len(np.atleast_1d(values)) != self.copies:
                raise ValueError(
                    f"vary[{name!r}] has shape {values.shape}; it must have {self.copies} entries, one for each copy"
                )
            other = "keyframes" if field == load.quantity else load.quantity
            found = [replace(one, **{field: values[copy], other: None}) for copy, one in enumerate(found)]
        return found

    def refuse_rest(self):
        """Checks that every name was taken.

        Raises:
            ValueError: A name is nothing that can vary in this scene, or a class whose terms all vary under their own names.
        """
        rest = sorted(set(self.values) - self.taken, key=str)
        shared = [name for name in rest if name in ("duration", "fps", "pins.keyframes")]
        if shared:
            raise ValueError(
                f"vary[{shared[0]!r}] is the same for all copies, which share their time and the motion of their pins"
            )
        again = [name for name in rest if name in self.fields]
        if again:
            kind = again[0].partition(".")[0]
            raise ValueError(f"vary[{again[0]!r}] changes nothing: every {kind} has an entry under its own name; leave it out")
        if rest:
            allowed = ["gravity", "density or masses", "positions", "velocities", *dict.fromkeys(self.fields)]
            raise ValueError(f"vary[{rest[0]!r}] names nothing in this scene; allowed are {', '.join(allowed)}")


def unlike_copies(values):
    """Returns values (B, …), or the first of them, (1, …), if copies share them by a stride of 0."""
    return values[:1] if values.strides[0] == 0 else values
