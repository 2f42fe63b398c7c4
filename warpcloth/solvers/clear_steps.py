"""Takes steps without contact while no vertex comes near a collider."""

from functools import partial

import numpy as np
import warp as wp

from ..core.capture import Mirror, Segment
from ..kernels.contact import clearance as kernels
from ..kernels.contact.colliders import shapes
from ..kernels.loop import count_down
from ..terms.refresh import STEP

# Largest number of sweeps of a step that are captured one by one; more become a loop on the device.
UNROLLED = 64
# How far edges may be stretched, at most, where triangles far from the meshes among the colliders are told by their vertices.
STRETCHED = 4.0


class TwinSteps:
    """The base class that lets a twin of a stepper, without contact, take the steps in which nothing comes near.

    A test before a step decides. A second test, after the step, finds whether contact was missed; then the step is taken again
    with contact, so that every step ends at the minimiser of the same problem. A subclass has ``_launch_look``, the first test,
    which also saves the state in ``_kept``; ``_launch_check``, the second test; and ``_launch_count``, after a step without
    contact, or None.

    Args:
        stepper: The :class:`warpcloth.solvers.solver.Stepper`.
        twin: A stepper with the same options on the model without contact, which shares its state.

    Attributes:
        twin: As given.
        near: Whether the last step was taken with contact, (1,) int32.
    """

    def __init__(self, stepper, twin):
        self.stepper, self.twin, device = stepper, twin, stepper.model.device
        self.near, self._left = (wp.zeros(1, dtype=wp.int32, device=device) for _ in range(2))
        self._kept = {name: wp.zeros_like(array) for name, array in twin.state.arrays.items()}

    def record(self):
        """Captures the launches of :meth:`step`."""
        launches = self._launch_look, self._launch_check, self._launch_restore, self._launch_count
        self._segments = [launch and Segment(self.stepper.model.device, launch) for launch in launches]
        self._read = Mirror(self.near)

    def step(self, touching):
        """Takes a step of a method that reads on the host; ``touching`` is a function that takes it with contact."""
        stepper, twin = self.stepper, self.twin
        look, check, restore, count = self._segments
        look()
        if not self._read.read()[0]:
            twin.results, twin.residual = stepper.results, stepper.residual
            twin.step()
            check()
            if not self._read.read()[0]:
                if count:
                    count()
                stepper.results, stepper.residual, stepper.iterations = twin.results, twin.residual, twin.iterations
                return
            restore()
        touching()

    def constraint_forces(self, touching, clear):
        """Returns a function (array) that launches ``touching(array)`` if the last step had contact, else ``clear(array)``."""
        return lambda out: wp.capture_if(self.near, lambda: touching(out), lambda: clear(out))

    def parts(self, touching):
        """Returns the part of a step, see :meth:`warpcloth.solvers.solver.LaunchedStepper.record`, from those with contact.

        A step has two conditions, however many sweeps it has.
        """
        return [(partial(self._launch_step, touching), 1)]

    def _launch_step(self, touching):
        self._launch_look()
        wp.capture_if(self.near, None, self._launch_clear)
        wp.capture_if(self.near, partial(self._launch_again, touching), self._launch_count)

    def _launch_clear(self):
        self._launch_parts(self.twin.parts)
        self._launch_check()

    def _launch_again(self, touching):
        self._launch_restore()
        self._launch_parts(touching)

    def several(self, steps, size):
        """Returns whether :meth:`launch_several` can take this number of steps of ``size`` launches with one test."""
        return False

    def _launch_restore(self):
        for name, array in self.twin.state.arrays.items():
            wp.copy(array, self._kept[name])

    def _launch_parts(self, parts):
        for launch, times in parts:
            if times <= UNROLLED:
                for _ in range(times):
                    launch()
            else:
                self._launch_in_turn(launch, times)

    def _launch_in_turn(self, launch, times):
        """Launches a loop on the device."""
        self._left.fill_(times)
        wp.capture_while(self._left, partial(self._launch_one, launch, self.stepper.model.kernel(count_down)))

    def _launch_one(self, launch, count):
        launch()
        self.stepper.model.launch(count, 1, [], [self._left])


class ClearSteps(TwinSteps):
    """Lets a twin of a stepper, without colliders, take the steps in which no vertex comes near a collider.

    Before a step, vertices count as near if twice the displacement of the prediction reaches a collider.
    """

    _launch_count = None  # the test after the step counts it

    # Largest number of launches of a graph of several steps, because to capture one takes 100 µs.
    LAUNCHES = 1024

    def __init__(self, stepper, twin):
        super().__init__(stepper, twin)
        model, colliders, self._followed = stepper.model, stepper.colliders, False
        self._others = [name for name in self._kept if name not in ("x", "v")]
        self._steps_kept, self._moving = wp.zeros_like(colliders.steps), any(model.colliders.moves)
        colliders.launch_move()  # once, where all stand
        radii = np.zeros((model.count, 4))
        radii[:, 3] = -1.0
        if model.pins is None and not self._moving:
            radii[model.inverse_mass.numpy() == 0.0, 3] = np.inf  # pins may stand near
        clear = kernels.balls(model.dtype)()
        clear.balls = model.array(radii, wp.types.vector(4, model.dtype))
        clear.found = wp.zeros(model.count, dtype=wp.int32, device=model.device)
        clear.drift, clear.distance = colliders.drift, model.colliders.distance
        clear.x, clear.v, clear.step = self._kept["x"], self._kept["v"], self._steps_kept
        self._bounds = shapes(model.dtype)()
        halves, bounding = zip(*(collider.centred().bounds for collider in model.scene.colliders), strict=True)
        if colliders.faces is not None:
            # Points of a triangle are no farther from one of its vertices than its longest edge over √3.
            max_length = STRETCHED / np.sqrt(3.0) * float(model.scene.mesh.edge_lengths.max())
            bounding = np.array(bounding) + [max_length if collider.facets else 0.0 for collider in model.scene.colliders]
        self._bounds.core, self._bounds.radius = model.array(np.array(halves), model.vec3), model.array(bounding, model.dtype)
        self._given = [[self._bounds, *model.free_gravity], [colliders.poses, colliders.steps, model.per_copy]]
        self._out = [clear, self.near]
        self._finds = [model.kernel(kernels.near_colliders, model.dtype, ended) for ended in (False, True)]
        self._contact = [elements for elements in model.terms if elements.collider is not None]

    def follow(self):
        """Makes steps without contact refresh the terms of contact too."""
        self._followed = True
        self.stepper.colliders.follow()

    def several(self, steps, size):
        standing = not (self._moving or self._followed)
        return self.stepper.model.device.is_cuda and standing and steps > 1 and steps * size <= self.LAUNCHES

    def launch_several(self, touching, steps):
        """Launches several steps. If no vertex comes near in any of them, they have two conditions together.

        The test before the steps assumes that a vertex moves by twice its prediction over all of them. That after each step
        compares its end with the positions before the first one: the ball of a vertex is convex, so that it contains the motion
        if it contains the ends of all steps. If one fails, all steps are taken again with contact.
        """
        self._launch_look(steps)
        wp.capture_if(self.near, None, partial(self._launch_all_clear, steps))
        wp.capture_if(self.near, partial(self._launch_all_again, touching, steps))

    def _launch_all_clear(self, steps):
        for _ in range(steps):
            self._launch_clear()

    def _launch_all_again(self, touching, steps):
        self._launch_restore()
        for _ in range(steps):
            self._launch_parts(touching)

    def _launch_look(self, steps=1):
        """Launches the test before a number of steps, and saves the state."""
        stepper = self.stepper
        if self._moving:
            stepper.colliders.launch_move()
        self.near.zero_()
        if self._followed:
            with stepper.colliders.reading_anchors():
                stepper.model.refresh(STEP, stepper.integrator.moment, self._contact)
        for name in self._others:
            wp.copy(self._kept[name], self.twin.state.arrays[name])
        self._launch(0, *stepper.state, None, steps)

    def _launch_check(self):
        """Launches the test after a step, clears the friction anchors of earlier steps, and counts the step."""
        colliders = self.stepper.colliders
        colliders.launch_release()
        self._launch(1, self._kept["x"], self._kept["v"], self.stepper.state.x)
        colliders.launch_count()

    def _launch_restore(self):
        super()._launch_restore()
        wp.copy(self.stepper.colliders.steps, self._steps_kept)

    def _launch(self, find, x, v, end, steps=1):
        (elements, others), model, h = self._given, self.stepper.model, steps * self.stepper.h
        model.launch(self._finds[find], model.count, [*elements, x, v, end, *others, h], self._out)
