"""Ray-casts surfaces, tubes and balls in sun and sky."""

import numpy as np
import warp as wp

from ..base.checks import array, choice, number, refuse, whole
from ..base.quiet import find_device
from ..base.turns import in_turn
from ..core.thread_pool import ThreadPool
from ..kernels import develop, render, shading
from ..model.elements import incidences_of
from ..model.threads import cores, threads_on
from .patterns import disc, pixel_samples

BACKGROUND = (0.90, 0.92, 0.94)
GROUND = BACKGROUND  # only shadows show on the ground, because a fade to another colour has visible bands in 8 bits
_UP = {"Y": (0.0, 1.0, 0.0), "Z": (0.0, 0.0, 1.0)}
# Length of a ray to the sky, and distance at which the ground has faded, relative to half the height of the picture.
_SKY_DISTANCE, _GROUND = 1.0, 6.0
# Fraction of sky light on a surface that faces the sun, and how much brighter it is from above than from below, where a light
# ground reflects it.
_SKY, _TILT = 0.42, 0.15
# Beyond these coordinates, products of three overflow in float32.
_FARTHEST = 1e9
# With this number of samples per pixel or more, noise is too small to need smoothing.
_PLAIN = 32
# Number of rows that a CPU thread takes at a time.
_ROWS = 8


class RayCaster:
    """Draws moving shapes; allocates once.

    Light comes from the sky and from a sun over the viewer's right shoulder, one ray to each from a visible point. A surface
    that faces the sun and sees the whole sky shows its own colour, and light is at most 1.01. On one device equal input gives
    equal bytes.

    Args:
        shapes: List of :class:`Shape`.
        samples: Rays through each pixel.
        ground: Height of a ground that fades into the background [m], or None.
        threads: Threads of the CPU, by default all cores.
        sun_angle: Angular diameter of the sun [°].
        contrast: Strength of shading on coloured surfaces, 0 to 1.
        background: Linear Rec. 709.

    Attributes:
        left_out: Elements not drawn by the last :meth:`image`, because a point is not finite or too far away.

    Raises:
        ValueError: A number is out of range, or there is no such device.
    """

    def __init__(
        self,
        shapes,
        width,
        height,
        samples=4,
        ground=None,
        device="cpu",
        up_axis="Y",
        threads=None,
        sun_angle=5.0,
        contrast=0.6,
        background=BACKGROUND,
    ):
        for name, value, most in (("width", width, 16384), ("height", height, 16384), ("samples", samples, 1024)):
            whole(name, value, 1, most)
        if ground is not None:
            number("ground", ground)
        choice("up_axis", up_axis, tuple(_UP))
        number("sun_angle", sun_angle, least=0.0)
        number("contrast", contrast)
        if not 0.0 <= contrast <= 1.0:
            raise ValueError(f"contrast is {contrast}; it must be a number from 0 to 1")
        self.shapes, self.left_out = list(shapes), 0
        self._size = int(width), int(height)
        self._ground, self._up = ground, np.array(_UP[up_axis])
        self._contrast = contrast
        self._background = array("background", background, (3,))
        self._device = find_device(device)
        self._pool = ThreadPool(cores(self._device) if threads is None else threads_on(self._device, threads))
        self._allocate(samples, sun_angle)

    @in_turn
    def _allocate(self, samples, sun_angle):
        shapes, offsets = self.shapes, np.cumsum([0, *(shape.count for shape in self.shapes)])
        empty = np.empty((0, 3), np.int32)
        self._points = np.zeros((max(1, offsets[-1]), 3))
        self._triangles = np.concatenate(
            [empty, *(s.triangles + o for s, o in zip(shapes, offsets, strict=False))], dtype=np.int32
        )
        tubes, radii = [empty[:, :2]], [np.empty(0)]
        for shape, offset in zip(shapes, offsets, strict=False):
            tubes += [shape.lines + offset, np.stack([shape.balls, shape.balls], axis=1) + offset]
            radii += [np.full(len(shape.lines), shape.radius), np.full(len(shape.balls), shape.ball_radius)]
        self._tubes, self._radii = np.concatenate(tubes, dtype=np.int32), np.concatenate(radii)
        smooth = np.repeat([int(s.smooth) for s in shapes], [len(s.triangles) for s in shapes])
        flat = self._triangles.ravel()
        starts, corners = incidences_of(flat, len(self._points))
        pixels = self._size[0] * self._size[1]
        with wp.ScopedDevice(self._device):
            g = self._geometry = render.Geometry()
            g.points = wp.zeros(len(self._points), dtype=wp.vec3)
            g.triangles = wp.array(flat, dtype=wp.int32)
            g.normals = wp.zeros(len(flat), dtype=wp.vec3)
            g.ends = wp.array(self._tubes, dtype=wp.vec2i)
            g.radii = wp.zeros(len(self._radii), dtype=wp.float32)
            self._smoothing = [wp.array(a.astype(np.int32), dtype=wp.int32) for a in (smooth, starts, corners)]
            self._faces = [wp.zeros(len(self._triangles), dtype=wp.vec3), wp.zeros(len(flat), dtype=wp.float32)]
            self._bounds = [wp.zeros(len(self._radii), dtype=wp.vec3) for _ in range(2)]
            layers = self._layers = render.Layers()
            layers.base, layers.sky, layers.sun, layers.normal, layers.point = (
                wp.zeros(pixels, dtype=wp.vec3) for _ in range(5)
            )
            layers.visible = wp.zeros(pixels, dtype=wp.vec2)
            self._samples = wp.array(pixel_samples(samples), dtype=wp.vec2)
            radius = np.tan(np.radians(sun_angle) / 2.0)
            self._sun_rays = wp.array(radius * disc(16 * samples), dtype=wp.vec2)
            # Malley's method: points of a disc projected to the hemisphere have a cosine density.
            flat = disc(256 * samples)
            lifted = np.sqrt(1.0 - (flat**2).sum(axis=1, keepdims=True))
            self._sky_rays = wp.array(np.concatenate([flat, lifted], axis=1), dtype=wp.vec3)
            self._visible = wp.zeros_like(layers.visible)
            self._smooth = samples < _PLAIN
            self._image = wp.zeros((pixels, 3), dtype=wp.uint8)

    @in_turn
    def image(self, points, camera, colours=None):
        """Draws a picture.

        Args:
            points: Positions (n, 3) of each shape [m]. Elements that are not finite are not drawn.
            camera: A :class:`Camera`.
            colours: Of each shape, linear Rec. 709: (n, 3) of vertices, (T, 3, 3) of corners, (E, 2, 3) of ends of lines, or
                None.

        Returns:
            np.ndarray: (height, width, 3) uint8 in sRGB.

        Raises:
            ValueError: A shape is another.
        """
        if len(points) != len(self.shapes):
            raise ValueError(f"points has {len(points)} arrays; there are {len(self.shapes)} shapes")
        colours = [None] * len(self.shapes) if colours is None else colours
        if len(colours) != len(self.shapes):
            raise ValueError(f"colours has {len(colours)} entries; there are {len(self.shapes)} shapes")
        unit, viewer = self._viewer(camera)
        with wp.ScopedDevice(self._device):
            self._set_positions(points, camera, unit)
            self._colour(colours)
            light = self._light(camera, unit)
            self._launch_rows(render.trace(), [self._geometry, viewer, light], [self._layers])
            if self._smooth:
                for step, vertical in ((1, 0), (1, 1), (4, 0), (4, 1)):
                    visible, other = self._layers.visible, self._visible
                    self._launch_rows(develop.smooth(), [self._layers, visible, viewer, vertical, step], [other])
                    self._layers.visible, self._visible = other, visible
            width, height = self._size
            wp.launch(develop.develop(), width * height, inputs=[self._layers], outputs=[self._image])
            return self._image.numpy().reshape(height, width, 3).copy()

    def _viewer(self, camera):
        """Returns the unit of length of the picture [m], a power of two, and the rays in it."""
        width, height = self._size
        position, target, up = (np.asarray(a) for a in (camera.position, camera.target, camera.up))
        forward = target - position
        distance = np.linalg.norm(forward)
        tangent = np.tan(np.radians(camera.fov) / 2.0)
        unit = 2.0 ** np.ceil(np.log2(distance * tangent))
        forward /= distance
        right = np.cross(forward, up / np.linalg.norm(up))
        right /= np.linalg.norm(right)
        pixel = 2.0 * tangent / height
        above = np.cross(right, forward)
        shift = 2.0 * tangent * (camera.shift * right + camera.rise * above)
        viewer = render.Viewer()
        viewer.origin, viewer.forward = wp.vec3(*((position - target) / unit)), wp.vec3(*(forward + shift))
        viewer.right, viewer.up = wp.vec3(*(pixel * right)), wp.vec3(*(pixel * above))
        viewer.width, viewer.height, viewer.samples = width, height, self._samples
        return unit, viewer

    def _light(self, camera, unit):
        sun = camera.sun(self._up)
        light = render.Light()
        light.up, light.sun = wp.vec3(*self._up), wp.vec3(*sun)
        light.sun_rays, light.sky_rays = self._sun_rays, self._sky_rays
        # light = sky (1 + tilt (n·up − 1)) + sun n·s is 1 for n = s
        full = _SKY * (1.0 + _TILT * (sun @ self._up - 1.0)) + 1.0 - _SKY
        light.sky_share, light.sun_share, light.sky_tilt = _SKY / full, (1.0 - _SKY) / full, _TILT
        half = np.linalg.norm(np.subtract(camera.target, camera.position)) * np.tan(np.radians(camera.fov) / 2.0) / unit
        light.sky_distance, light.ground_radius = _SKY_DISTANCE * half, _GROUND * half
        light.has_ground = int(self._ground is not None)
        if self._ground is not None:
            light.ground = float((self._ground - np.dot(camera.target, self._up)) / unit)
        light.ground_colour, light.background = wp.vec3(*GROUND), wp.vec3(*self._background)
        return light

    def _set_positions(self, points, camera, unit):
        first = 0
        for k, (shape, found) in enumerate(zip(self.shapes, points, strict=True)):
            found = np.asarray(found)
            if found.shape != (shape.count, 3):
                raise ValueError(f"points[{k}] has shape {found.shape}; it must be ({shape.count}, 3)")
            self._points[first : first + shape.count] = found
            first += shape.count
        with np.errstate(over="ignore", invalid="ignore"):
            local = (self._points - camera.target) / unit
            bad = ~(np.abs(local) < _FARTHEST).all(axis=1)
        local[bad] = 0.0
        flat, hollow = bad[self._triangles].any(axis=1), bad[self._tubes].any(axis=1)
        self.left_out = int(flat.sum() + hollow.sum())
        g = self._geometry
        g.points.assign(local)
        if len(self._triangles):
            g.triangles.assign(np.where(flat[:, None], 0, self._triangles).ravel())
            wp.launch(shading.face_normals(), len(flat), inputs=[g.triangles, g.points], outputs=self._faces)
            inputs = [g.triangles, *self._smoothing, *self._faces]
            wp.launch(shading.corner_normals(), 3 * len(flat), inputs=inputs, outputs=[g.normals])
            self._mesh = wp.Mesh(g.points, g.triangles)
            g.mesh = self._mesh.id
        if len(self._tubes):
            # At least as wide as a pixel, because a few samples may miss thinner tubes.
            eye = np.subtract(camera.position, camera.target) / unit
            nearest = np.linalg.norm(local[self._tubes] - eye, axis=2).min(axis=1)
            pixel = 2.0 * np.tan(np.radians(camera.fov) / 2.0) / self._size[1]
            g.radii.assign(np.where(hollow, 0.0, np.maximum(self._radii / unit, 0.5 * pixel * nearest)))
            wp.launch(shading.tube_bounds(), len(hollow), inputs=[g.ends, g.radii, g.points], outputs=self._bounds)
            self._tree = wp.Bvh(*self._bounds)
            g.tree = self._tree.id

    def _colour(self, colours):
        values, corners, ends = [], [], []
        shares, line_shares, backs = [], [], []
        first = 0

        def add(rows):
            nonlocal first
            values.append(rows)
            first += len(rows)
            return first - len(rows)

        for k, (shape, found) in enumerate(zip(self.shapes, colours, strict=True)):
            balls = np.full((len(shape.balls), 2), add(shape.ball_colour[None]))
            plain = add(shape.colour[None])
            corner, end = np.full(shape.triangles.shape, plain), np.full(shape.lines.shape, plain)
            painted = [False, False]
            if found is not None:
                found = np.asarray(found, dtype=np.float64)
                refuse(f"colours[{k}]", found, ~np.isfinite(found), "must be finite")
                if found.shape == (shape.count, 3):
                    start = add(found)
                    corner, end, painted = shape.triangles + start, shape.lines + start, [True, True]
                elif found.shape == (len(shape.triangles), 3, 3):
                    corner, painted[0] = add(found.reshape(-1, 3)) + np.arange(corner.size).reshape(-1, 3), True
                elif found.shape == (len(shape.lines), 2, 3):
                    end, painted[1] = add(found.reshape(-1, 3)) + np.arange(end.size).reshape(-1, 2), True
                else:
                    raise ValueError(
                        f"colours[{k}] has shape {found.shape}; it must be ({shape.count}, 3) of vertices, "
                        f"({len(shape.triangles)}, 3, 3) of corners or ({len(shape.lines)}, 2, 3) of ends of lines"
                    )
            corners.append(corner)
            ends += [end, balls]
            shares.append(np.full(len(corner), self._contrast if painted[0] else 1.0))
            line_shares += [np.full(len(end), self._contrast if painted[1] else 1.0), np.ones(len(balls))]
            backs.append(np.tile((1.0, 1.0, 1.0) if painted[0] else shape.back, (len(corner), 1)))
        g = self._geometry
        none = np.empty((0, 3))
        g.colours = wp.array(np.concatenate([none, *values]), dtype=wp.vec3)
        g.corner_colours = wp.array(np.concatenate([none, *corners]).ravel(), dtype=wp.int32)
        g.end_colours = wp.array(np.concatenate([none[:, :2], *ends]), dtype=wp.vec2i)
        g.shares = wp.array(np.concatenate([none[:, 0], *shares, *line_shares]), dtype=wp.float32)
        g.backs = wp.array(np.concatenate([none, *backs]), dtype=wp.vec3)

    def _launch_rows(self, kernel, inputs, outputs):
        width, height = self._size
        step = _ROWS if self._device.is_cpu else height
        launches = iter(
            [
                wp.launch(kernel, min(step, height - row) * width, [*inputs, row * width], outputs, record_cmd=True)
                for row in range(0, height, step)
            ]
        )

        def work():
            for launch in launches:
                launch.launch()

        self._pool.run([work] * self._pool.threads)
