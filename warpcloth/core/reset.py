"""Resets copies to their start, between steps."""

import numpy as np
import warp as wp

from ..base.checks import array, as_array, shown
from ..kernels import step as kernels
from ..model.precision import cast
from .capture import Mirror
from .status import Result


class Reset:
    """Resets copies of a stepper to their start, see :meth:`warpcloth.solvers.solver.Stepper.reset`.

    Args:
        stepper: The :class:`warpcloth.solvers.solver.Stepper`.
        model, state: Those of some of its copies, if not those of the stepper.
    """

    def __init__(self, stepper, model=None, state=None):
        self.stepper, self.model, self.state = stepper, model or stepper.model, state or stepper.state
        self._kernel = None
        self._buffers = {}  # for values from the host, allocated on first use

    def _prepare(self):
        """Makes the kernel, and the addresses and sizes of the arrays of the state other than x and v, and of their starts."""
        model, state = self.model, self.state
        names = [name for name in state.arrays if name not in ("x", "v")]
        carried, starts = ([arrays.get(name) for name in names] for arrays in (state.arrays, state.starts))
        words = [wp.types.type_size_in_bytes(array.dtype) // 4 * (array.size // len(array)) for array in carried]
        per_vertex = [len(array) == model.count and model.per_copy > 1 for array in carried]
        words = [count if each else -count for count, each in zip(words, per_vertex, strict=True)]
        self._given = [
            wp.array([0 if array is None else array.ptr for array in starts], dtype=wp.uint64, device=model.device),
            wp.array(words, dtype=wp.int32, device=model.device),
            wp.array([array.ptr for array in carried], dtype=wp.uint64, device=model.device),
        ]
        self._kernel = model.kernel(kernels.reset, model.dtype, model.pins is not None)

    def __call__(self, mask, positions, velocities):
        stepper, model, state = self.stepper, self.model, self.state
        if state.starts and not (positions is None and velocities is None):
            raise ValueError(
                f"reset takes no positions or velocities with integrator={stepper.options.integrator!r}, which knows what was "
                "before the start of the model alone; an integrator of one step, such as 'euler', takes them"
            )
        mask, x, v = self.on_device(mask, positions, velocities)
        x, v = model.positions if x is None else x, model.velocities if v is None else v
        if stepper.pairs is not None and x is not model.positions and stepper.pairs.refuse_reset(mask.numpy(), x.numpy()):
            stepper.record_again()
        if self._kernel is None:
            self._prepare()
        starts, words, carried = self._given
        given = [model.inverse_mass, model.positions, x, v, starts, mask, model.per_copy, words]
        model.launch(self._kernel, model.count, given, [carried, *state])
        model.lock(state.v)
        if state.residual.any() or any(result is not Result.COMPLETED for result in state.results):
            chosen = mask.numpy()
            state.residual = np.where(chosen, 0.0, state.residual)
            state.results = [Result.COMPLETED if again else result for result, again in zip(state.results, chosen, strict=True)]

    def on_device(self, mask, positions, velocities):
        """Returns the mask (B,), and positions and velocities, (B·n,) vectors or None, as Warp arrays.

        Raises:
            ValueError: An argument is not allowed.
        """
        mask = self._mask(mask)
        x = None if positions is None else self._vectors("positions", "m", positions)
        v = None if velocities is None else self._vectors("velocities", "m/s", velocities)
        if x is not None and self.model.scene.colliders:
            self._refuse_inside(mask.numpy(), x.numpy())
        return mask, x, v

    def _refuse_inside(self, mask, x):
        """Raises ValueError if a free vertex of a copy in ``mask`` (B,) is inside a collider at positions x (B·n, 3) [m]."""
        model = self.model
        points = model.in_scene_order(x.astype(np.float64)).reshape(model.copies, -1, 3)
        for copy in np.flatnonzero(mask):
            model.scene.refuse_inside(points[copy], f" in copy {copy}" if model.copies > 1 else "")

    def _mask(self, mask):
        """Returns the mask on the device, (B,)."""
        B = self.model.copies
        if self._on_device(mask):
            if mask.dtype is not wp.bool or mask.shape != (B,) or not mask.is_contiguous:
                raise ValueError(f"mask is {_kind(mask)}; on the device it must be a contiguous array ({B},) of wp.bool")
            return mask
        values = np.ones(B, dtype=bool) if mask is None else as_array(_host(mask))
        if values.dtype != bool or values.shape != (B,):
            raise ValueError(f"mask is {shown(mask)}; it must be an array ({B},) of truth values, one for each copy")
        return self._buffered("mask", wp.bool, B, values)

    def _vectors(self, name, unit, values):
        """Returns positions or velocities on the device, (B·n,) vectors."""
        model = self.model
        shape = (model.copies, model.per_copy, 3)
        if self._on_device(values):
            vectors = wp.types.types_equal(values.dtype, model.vec3)  # wp.vec3 is equal to it, but another class
            whole = (*values.shape, 3) if vectors else values.shape if values.dtype is model.dtype else ()
            if whole not in (shape, (model.count, 3)) or not values.is_contiguous:
                raise ValueError(
                    f"{name} is {_kind(values)}; on the device it must be a contiguous array {shape} of {model.dtype.__name__}"
                )
            return wp.array(ptr=values.ptr, shape=(model.count,), dtype=model.vec3, device=model.device)
        values = array(name, _host(values), shape)
        values = cast(name, unit, values, model.numpy_dtype, lambda copy, i: f"vertex {i} of copy {copy}")
        return self._buffered(name, model.vec3, model.count, values.reshape(-1, 3))

    def _on_device(self, values):
        return isinstance(values, wp.array) and values.device == self.model.device

    def _buffered(self, name, dtype, count, values):
        """Returns the values in a device array, which later calls use again."""
        if name not in self._buffers:
            self._buffers[name] = Mirror(wp.empty(count, dtype=dtype, device=self.model.device))
        self._buffers[name].write(values)
        return self._buffers[name].array


def _host(values):
    return values.numpy() if isinstance(values, wp.array) else values


def _kind(values):
    """Describes a Warp array, for error messages."""
    return f"an array {values.shape} of {values.dtype.__name__}"
