"""The explicit step in as few passes as its data allow: on the CPU one sweep over all elements, on CUDA one launch, or less."""

import numpy as np
import warp as wp

from ..kernels.fast import gather_step as kernels
from ..kernels.fast.parts import Part
from ..terms.refresh import EVALUATION, STEP, Moment
from .block_layout import in_blocks
from .gather_layout import chain, gathered, lanes
from .gradient import gradient
from .quadratic_pairs import as_pairs

# Of a block that is a copy; of 1024 vertices 256 threads take 2.1 times as long, 1024 1.2 times (H200).
THREADS = 512
# Vertices of such a copy at most: 132 copies of 64² take 1.5 times as long by 512 threads as by launches.
VERTICES = 1024
# Of the mean edge, what places may be rounded by, see `is_fine`.
ROUNDING = 4e-5
# What places are rounded by is packed in units of this times what x is rounded by, which leaves it whole for places so many
# times as far from the origin as those that are known beforehand.
FINER, FARTHER = 2.0**-6, 16.0


class Sweep:
    """Steps of one launch, of one thread a copy, see :func:`sweep`. What is refreshed is scattered before.

    Elements of a quadratic energy that is not damped are swept as the pairs of their matrix, see
    :mod:`warpcloth.fast.quadratic_pairs`.

    Args:
        model: The :class:`warpcloth.model.model.Model`.
        state: x and v (N,), which steps move on.
        h: Step [s].
        symplectic: Whether x moves on by the v after the step.
        fine: Whether what places are rounded by is kept, see :func:`is_fine`.

    Attributes:
        model: The model with its elements in the order of the sweep, but for those that are swept as pairs.
        low: What places are rounded by (N,) [m], or None.
    """

    def __init__(self, model, state, h, symplectic, fine=False):
        fresh, others = (
            [elements for elements in model.terms if (elements.refresh is None) == apart] for apart in (False, True)
        )
        self._fresh, self._gradient = gradient(model, terms=fresh), model.vectors()
        swept = [as_pairs(model, elements) for elements in others]
        vertices, swept, numbers = in_blocks(swept, model.per_copy, model.copies)
        kept = [after if after.term is before.term else before for before, after in zip(others, swept, strict=True)]
        self.model, self.state = model.with_terms([*fresh, *kept]), state
        damped = [elements.damping is not None for elements in swept]
        parts = [Part(each.term, own, 0 in each.stiffness.strides) for each, own in zip(swept, damped, strict=True)]
        # Contracted as on CUDA, where a product is added without being rounded: springs then take 0.8 of the time.
        flags = f"{wp.config.cpu_compiler_flags or ''} -ffp-contract=fast"
        self._kernel = model.kernel(kernels.sweep, tuple(parts), model.dtype, symplectic, flags, fine)
        self.low = model.vectors() if fine else None
        self._chain = chain(parts, [_swept(elements) for elements in swept], model.dtype)
        scratch = [
            wp.zeros(size, dtype=model.dtype, device=model.device) for size in (numbers, numbers * (fine or any(damped)))
        ]
        blocks = wp.array(vertices.astype(np.int32), dtype=wp.int32, device=model.device)
        self._given = [self._chain, blocks, model.inverse_mass, model.gravity, h, *scratch]

    def launch(self, steps, after_step):
        """So many steps, with a call of ``after_step`` (x, v) after each."""
        for _ in range(steps):
            self.model.refresh(STEP, Moment(self.state[0]))
            self._fresh.add(self.state[0], self._gradient)
            self.model.launch(self._kernel, self.model.copies, self._given, [self._gradient, *self.state, self.low])
            after_step(*self.state)


class Gather:
    """The same by gathering over the incidences of each vertex, see :func:`warpcloth.kernels.fast.gather_step.gather`.

    x, of what is damped v, and ``low`` go to and fro between two arrays; the last of an odd number of steps is copied back.
    ``low`` is packed where :func:`unit_of` says so, see :mod:`warpcloth.kernels.fast.packed_residual`. Where :func:`block_of`
    says so a copy is a block of threads and takes all steps in one launch.
    """

    def __init__(self, model, state, h, symplectic, fine=False):
        self.model = model
        self._found = [gathered(model, elements, elements.damping is not None) for elements in model.terms]
        parts = [part for part, _arrays in self._found]
        fast = model.device.is_cuda and model.dtype is wp.float32
        key = (tuple(parts), model.dtype, symplectic, fast)
        unit = unit_of(model) if fine else None
        kept = None if not fine else wp.int32 if unit else model.vec3
        self._lanes, self._threads = lanes(model), 0 if fine else block_of(model, parts)
        if self._threads:
            self._kernel = model.kernel(kernels.gather_copies, *key, self._threads)
        else:
            self._kernel = model.kernel(kernels.gather, *key, model.copies == 1, self._lanes, kept)
        self._chain = chain(parts, [arrays for _part, arrays in self._found], model.dtype)
        x, v = state
        self.low, low = (wp.zeros(model.count, dtype=kept, device=model.device) if fine else None for _ in range(2))
        self._states = [(x, v, self.low), (model.vectors(), model.vectors() if any(part.damped for part in parts) else v, low)]
        self._given = [self._chain, model.inverse_mass, model.gravity, model.per_copy, h]
        self._unit = unit or 1.0

    def launch(self, steps, after_step):
        """So many steps, with a call of ``after_step`` (x, v) after each."""
        model = self.model
        if self._threads:  # and nothing has to come after a step
            dim, states = (model.copies, self._threads), [*self._states[0][:2], *self._states[1][:2]]
            model.launch(self._kernel, dim, [*self._given, steps], states, block_dim=self._threads)
            return
        for step in range(steps):
            before, after = self._states[step % 2], self._states[1 - step % 2]
            for when in (STEP, EVALUATION):
                model.refresh(when, Moment(before[0]))
            model.launch(self._kernel, model.count * self._lanes, [*self._given, self._unit, *before], [*after])
            after_step(*after[:2])
        if steps % 2:
            for array, last in zip(*self._states, strict=True):
                if array is not last:
                    wp.copy(array, last)


def is_fine(model):
    """Whether explicit steps have to keep what they round places by, for the strain of edges to be right to half a point.

    In float32 places are rounded by about the strain that a step makes, and nothing damps the noise: after a second 1 % of the
    springs of ``hanging`` with 512 × 512 vertices are 0.81 percentage points off, with ``low`` 0.31, as in float64; of 256 ×
    256 vertices 0.33. Rounding at the farthest vertex is then above 4e-5 of the mean edge. Steps of what is damped or refreshed
    take forces at x alone and keep nothing; how far off these are has not been measured.
    """
    if model.dtype is not wp.float32 or any(elements.damping is not None or elements.refresh for elements in model.terms):
        return False
    lengths = model.scene.mesh.edge_lengths
    if not lengths.size or not lengths.any():
        return False
    return bool(_rounding(model.scene.positions) > ROUNDING * lengths.mean())


def unit_of(model):
    """The unit that what places are rounded by is packed in [m]; None if above an eighth of what :func:`is_fine` bears.

    A unit of 1e-4 of the mean edge leaves a sheet of small steps 15 times as far off as vectors do. It is for where copies
    start, where pins are led, and how far what has no pins gets in the scene.
    """
    scene, far = model.scene, _size(model.positions.numpy())
    if scene.pins.keyframes is not None:
        far = max(far, _size(scene.pins.keyframes))
    if not len(scene.pins.vertices):
        speed, g, seconds = _size(model.velocities.numpy()), _size(model.gravity.numpy()), scene.duration
        far = max(far, (speed + 0.5 * g * seconds) * seconds / FARTHER)
    unit = FINER * _rounding(far)
    return unit if unit <= 0.125 * ROUNDING * scene.mesh.edge_lengths.mean() else None


def _size(values):
    """The largest magnitude of numbers."""
    return float(np.abs(values).max(initial=0.0))


def _rounding(places):
    """The distance of neighbouring numbers of float32 at the farthest of places [m]."""
    return float(np.spacing(np.float32(_size(places))))


def block_of(model, parts):
    """Threads of the block that takes a small copy through all steps of a launch; 0 where each step has to be a launch.

    What a copy reads can then stay in the cache of its multiprocessor: springs of 132 copies of 32² vertices take 0.53 of the
    time of launches, of 4096 copies 0.47. Few copies are as fast by several threads a vertex, and leave multiprocessors idle.
    """
    between = model.pins is not None or any(elements.refresh for elements in model.terms)
    if between or lanes(model) > 1 or model.per_copy > VERTICES or not all(part.pairs for part in parts):
        return 0
    return min(THREADS, -(-model.per_copy // 32) * 32) if model.device.is_cuda else 1


def _swept(elements):
    """What the struct of the elements of a sweep has, by name."""
    offsets, codes = elements.pieces
    found = {"offsets": offsets, "codes": codes, "stencil": elements.stencil}
    found |= {"stiffness": elements.stiffness, "rest": elements.rest}
    return found if elements.damping is None else found | {"damping": elements.damping}
