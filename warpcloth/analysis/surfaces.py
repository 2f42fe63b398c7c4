"""Measures one frame against another on a device: triangles, or neighbourhoods of vertices."""

import numpy as np
import warp as wp

from ..base.checks import array, numeric, shown
from ..base.quiet import find_device
from ..base.turns import in_turn, methods_in_turn
from ..kernels import deformation, neighbourhood_fit, rates
from ..model.precision import DTYPES
from ..terms import TERMS
from ..terms.membrane import Membrane
from .neighbourhoods import neighbourhoods

# Measures of vertices that do not need F; any other measure does.
_WITHOUT_GRADIENT = ("rotation", "rotation_angle", "residual", "cross_covariance")
RATES = {"midpoint": rates.MIDPOINT, "forward": rates.FORWARD, "logarithm": rates.LOGARITHM}


class _Elements:
    """Results, which are allocated once, and rates between gradients.

    Attributes:
        values: Results (E, *shape) by measure, overwritten by each call.
    """

    def __init_subclass__(cls, **options):
        super().__init_subclass__(**options)
        methods_in_turn(cls, "__init__", "refer", "start", "measure", "touched")

    def __init__(self, count, measures, device, dtype):
        self.device, self.count, self.measures = find_device(device), count, measures
        self.scalar, self.numpy = DTYPES[dtype]
        self.vec3, self.mat33 = wp.types.vector(3, self.scalar), wp.types.matrix((3, 3), self.scalar)
        self.results = {measure.name: self.empty(self._kind(measure.shape)) for measure in measures}
        self.gradients, self.before, self.frames = (self.empty(self.mat33) for _ in range(3))
        self.materials = None
        self.sizes = self.empty(self.scalar)

    def empty(self, kind, count=None):
        return wp.empty(self.count if count is None else count, dtype=kind, device=self.device)

    def upload(self, values, kind):
        return wp.array(np.ascontiguousarray(values, dtype=self.numpy), dtype=kind, device=self.device)

    def centred(self, points):
        """Returns points (n, 3) on the device; in float32 relative to one of them."""
        if self.numpy is np.float32:
            finite = np.isfinite(points).all(axis=1)
            points = points - points[finite.argmax()] if finite.any() else points
        return self.upload(points, self.vec3)

    def launch(self, kernel, inputs, outputs, count=None):
        """Launches a kernel; outputs are arrays, or measures, which may not be chosen."""
        outputs = [self.results.get(out) if isinstance(out, str) else out for out in outputs]
        wp.launch(kernel, self.count if count is None else count, inputs=inputs, outputs=outputs, device=self.device)

    def chosen(self, struct):
        found = struct()
        for name in struct.vars:
            if name in self.results:
                setattr(found, name, self.results[name])
        return found

    def wanted(self, *names):
        return any(name in self.results for name in names)

    @in_turn
    def rates(self, dt, method, rounding):
        """Computes rates from ``before`` to ``gradients``, dt [s] later, of points with ``rounding`` [m]."""
        inputs = [self.materials, self.sizes, self.before, self.gradients]
        inputs += [self.scalar(dt), int(RATES[method]), self.scalar(rounding)]
        self.launch(rates.measure_rates(self.scalar), inputs, [self.chosen(rates.rate_measures(self.scalar))])

    @in_turn
    def read(self):
        return {name: found.numpy() for name, found in self.results.items()}

    def _kind(self, shape):
        if not shape:
            return self.scalar
        return wp.types.vector(shape[0], self.scalar) if len(shape) == 1 else wp.types.matrix(shape, self.scalar)


class Triangles(_Elements):
    """The triangles of a mesh.

    Attributes:
        without: Why a triangle may have no reference.

    Args:
        directions: Columns of :func:`material_directions` (T, 2, 2), or None.
    """

    without = "has no area"

    def __init__(self, mesh, measures, directions, material, device, dtype):
        super().__init__(len(mesh.triangles), measures, device, dtype)
        self.triangles = wp.array(mesh.triangles, dtype=wp.int32, device=self.device)
        self.inverse_edges = self.empty(self.vec3)
        if directions is not None:
            mat22 = wp.types.matrix((2, 2), self.scalar)
            self.coefficients, self.materials = self.upload(directions, mat22), self.empty(mat22)
        if material is not None:
            with np.errstate(all="ignore"):  # triangles without area are left out
                elements = material.elements(mesh, None)
            self.term = elements.term
            self.stiffness = self.upload(np.broadcast_to(elements.stiffness, self.count), self.scalar)
            self.rest = self.upload(elements.rest, wp.types.vector(self.term.parameters, self.scalar))

    def refer(self, X, rounding):
        """Sets the reference X (n, 3), with ``rounding`` [m]; returns which have none in it, (T,)."""
        outputs = (self.frames, self.inverse_edges, self.sizes)
        self.launch(deformation.frame_triangles(self.scalar), [self.triangles, self.centred(X), self.scalar(rounding)], outputs)
        if self.materials is not None:
            inputs = [self.coefficients, self.inverse_edges]
            self.launch(deformation.unit_directions(self.scalar), inputs, [self.materials])
        return np.isnan(self.inverse_edges.numpy()[:, 2])

    def start(self, x):
        """Sets the frame x (n, 3) that rates are taken from."""
        self._find_gradients(x, self.before)

    def measure(self, x):
        """Measures the frame x (n, 3), all but rates."""
        self._find_gradients(x, self.gradients)
        outputs = deformation.triangle_measures(self.scalar)
        if self.wanted(*outputs.vars):
            inputs = [self.frames, self.materials, self.gradients]
            self.launch(deformation.measure_triangles(self.scalar), inputs, [self.chosen(outputs)])
        outputs = deformation.stress_measures(self.scalar)
        if self.wanted(*outputs.vars):
            kernel = deformation.measure_stress(self.scalar, self.term)
            self.launch(kernel, [self.stiffness, self.rest, self.gradients], [self.chosen(outputs)])

    def _find_gradients(self, x, out):
        inputs = [self.triangles, self.inverse_edges, self.centred(x)]
        self.launch(deformation.triangle_gradients(self.scalar), inputs, [out])

    def touched(self, vertices):
        """Returns which triangles (T,) have one of the vertices (n,)."""
        return vertices[self.triangles.numpy()].any(axis=1)


class Neighbourhoods(_Elements):
    """The neighbourhood of each vertex of a mesh.

    Attributes:
        without: Why a vertex may have no reference.

    Args:
        neighbourhood: As of :func:`warpcloth.analysis.neighbourhoods.neighbourhoods`.
    """

    without = "is in no triangle with area, or its neighbours lie on a line"

    def __init__(self, mesh, measures, neighbourhood, device, dtype):
        super().__init__(len(mesh.points), measures, device, dtype)
        self.host = neighbourhoods(mesh, neighbourhood)
        corners = mesh.triangles.ravel()
        incident = np.argsort(corners, kind="stable") // 3
        offsets = np.concatenate([[0], np.cumsum(np.bincount(corners, minlength=self.count))])
        self.offsets, self.members, self.triangle_offsets, self.incident = (
            wp.array(part.astype(np.int32), dtype=wp.int32, device=self.device) for part in (*self.host, offsets, incident)
        )
        self.triangles = wp.array(mesh.triangles, dtype=wp.int32, device=self.device)
        self.normals, self.reference_normals = self.empty(self.vec3), self.empty(self.vec3)
        self.rotations = self.results.get("rotation")
        if self.rotations is None and self.wanted("rotation_angle"):
            self.rotations = self.empty(self.mat33)
        self.fitted = any(name not in _WITHOUT_GRADIENT for name in self.results)
        self.sizes = self.upload(np.sqrt(mesh.vertex_areas), self.scalar)

    def refer(self, X, rounding):
        """Sets the reference X (n, 3), with ``rounding`` [m]; returns which have none in it, (n,)."""
        self.X, self.rounding = self.centred(X), self.scalar(rounding)
        self._find_normals(self.X, self.reference_normals)
        self._fit(X, [self.gradients, self.frames, None, None, None])
        return np.isnan(self.gradients.numpy()[:, 0, 0])

    def start(self, x):
        """Sets the frame x (n, 3) that rates are taken from."""
        self._fit(x, [self.before, self.frames, None, None, None])

    def measure(self, x):
        """Measures the frame x (n, 3), all but rates."""
        gradients = self.gradients if self.fitted else None
        self._fit(x, [gradients, self.frames, self.rotations, "residual", "cross_covariance"])
        outputs = neighbourhood_fit.neighbourhood_measures(self.scalar)
        if self.wanted(*outputs.vars):
            inputs = [self.gradients, self.frames, self.rotations]
            self.launch(neighbourhood_fit.measure_neighbourhoods(self.scalar), inputs, [self.chosen(outputs)])

    def touched(self, vertices):
        """Returns which neighbourhoods (n,) have one of the vertices (n,)."""
        offsets, members = self.host
        return np.bincount(np.repeat(np.arange(self.count), np.diff(offsets)), vertices[members], self.count) > 0.0

    def _find_normals(self, x, out):
        inputs = [self.triangle_offsets, self.incident, self.triangles, x]
        self.launch(neighbourhood_fit.vertex_normals(self.scalar), inputs, [out])

    def _fit(self, x, outputs):
        x = self.centred(x)
        if outputs[0] is not None:
            self._find_normals(x, self.normals)
        inputs = [self.offsets, self.members, self.reference_normals, self.X, self.normals, x, self.rounding]
        self.launch(neighbourhood_fit.neighbourhood_gradients(self.scalar), inputs, outputs)


def material_directions(mesh, chosen):
    """Returns two material directions of each triangle as coefficients α of α₁(X₁ − X₀) + α₂(X₂ − X₀), (T, 2, 2), in columns.

    They are those along which one texture coordinate grows and the other is constant, for "st", or a vector (3,), projected to
    the triangle at rest, and the perpendicular; NaN if undefined.

    Raises:
        ValueError: ``chosen`` is neither, there are no texture coordinates, or no triangle has directions.
    """
    rule = 'be "st" or a vector (3,)'
    X = mesh.points[mesh.triangles]
    edges = np.stack([X[:, 1] - X[:, 0], X[:, 2] - X[:, 0]], axis=2)
    with np.errstate(all="ignore"):
        if isinstance(chosen, str):
            if chosen != "st":
                raise ValueError(f"directions is {shown(chosen)}; it must {rule}")
            st = mesh.corner_coordinates
            if st is None:
                raise ValueError('directions = "st": the mesh has no texture coordinates that were read; give a vector')
            Ds = np.stack([st[:, 1] - st[:, 0], st[:, 2] - st[:, 0]], axis=2)
            determinant = Ds[:, 0, 0] * Ds[:, 1, 1] - Ds[:, 0, 1] * Ds[:, 1, 0]
            cofactors = np.stack([Ds[:, 1, 1], -Ds[:, 0, 1], -Ds[:, 1, 0], Ds[:, 0, 0]], axis=1).reshape(-1, 2, 2)
            flat = ~(np.abs(determinant) > 1e-7 * (Ds**2).sum(axis=(1, 2)))
            coefficients = cofactors / np.where(flat, np.nan, determinant)[:, None, None]
        else:
            vector = array("directions", numeric("directions", chosen, rule), (3,))
            length = np.linalg.norm(vector)
            if length == 0.0:
                raise ValueError("directions is the vector 0, which has none")
            normal = np.cross(edges[:, :, 0], edges[:, :, 1])
            normal /= np.linalg.norm(normal, axis=1)[:, None]
            along = vector / length - (normal @ (vector / length))[:, None] * normal
            along[~(np.linalg.norm(along, axis=1) > 1e-6)] = np.nan
            both = np.stack([along, np.cross(normal, along)], axis=2)
            gram = np.swapaxes(edges, 1, 2) @ edges
            determinant = gram[:, 0, 0] * gram[:, 1, 1] - gram[:, 0, 1] ** 2
            inverse = np.stack([gram[:, 1, 1], -gram[:, 0, 1], -gram[:, 1, 0], gram[:, 0, 0]], axis=1).reshape(-1, 2, 2)
            coefficients = inverse @ (np.swapaxes(edges, 1, 2) @ both) / determinant[:, None, None]
    if not np.isfinite(coefficients).all(axis=(1, 2)).any():
        raise ValueError(f"directions = {shown(chosen)}: no triangle has such directions")
    coefficients[~np.isfinite(coefficients).all(axis=(1, 2))] = np.nan
    return coefficients


def check_material(material):
    """Raises ValueError unless ``material`` is None or a membrane."""
    if not isinstance(material, Membrane):
        names = ", ".join(name for name, kind in TERMS.items() if issubclass(kind, Membrane))
        raise ValueError(
            f"material is {shown(material)}; it must be a membrane ({names}), such as "
            "NeoHookeanMembrane(stiffness=1e3, poisson_ratio=0.3)"
        )
