"""Colliders read from the prims of a stage."""

import warnings
from contextlib import contextmanager
from functools import cached_property

import numpy as np

from ..mesh.flat_triangles import without_slivers
from ..scene.colliders import Box, Capsule, Plane, Sphere
from ..scene.mesh_collider import MeshCollider, first_extended
from .attributes import Values, has_api, holders
from .modules import Usd, UsdGeom, UsdPhysics
from .solids import SOLIDS
from .stage import face_corners, local_to_metres, moving_space, placed, refuse_moving_topology, space_codes
from .values import array_of, check_composed, refuse_unknown, time_codes_of, token_of, value_of

# Approximations of a mesh in UsdPhysics that are supported, and those that count as none: they make a mesh cheaper for rigid
# bodies, which is not needed here.
_APPROXIMATIONS = ("none", "boundingCube", "boundingSphere", "convexHull")
_TAKEN_AS_NONE = ("convexDecomposition", "meshSimplification", "sdf")
_SIZES = ("size", "radius", "height")
# Relative tolerance of scales and angles that come from float32 and their products.
_SAME = 1e-5


def read_colliders(stage, cloths, surroundings, codes):
    """Reads the colliders of a stage, in the order of its prims.

    A collider is a shape, visible or not, with PhysicsCollisionAPI or `warpcloth:collider`, on it or on the Xform above; cloth
    is none. Planes, spheres, capsules and cubes become primitives if their scale allows it; other shapes, and those that change
    in size, meshes. ``codes`` turns time codes of samples into those of frames.

    Raises:
        ValueError: A prim cannot be a collider; the message has its path.
    """
    found = []
    walk = iter(Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies()))
    for prim in walk:
        with errors_at(f"{surroundings.path}, prim {prim.GetPath()}"):
            if prim.IsA(UsdGeom.PointInstancer):
                walk.PruneChildren()
                if any(map(collides, Usd.PrimRange(prim, Usd.TraverseInstanceProxies()))):
                    raise ValueError("has a collider as a prototype, which must be instanced by references to be taken")
            wanted = prim not in cloths and collides(prim)
        if wanted:
            check_composed(prim, surroundings.path)
            with errors_at(f"{surroundings.path}, prim {prim.GetPath()}"):
                found.append(_Reader(stage, prim, surroundings, codes).collider())
    return found


@contextmanager
def errors_at(where):
    """Prefixes the message of a ValueError with ``where``."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error


def _mark(prim):
    """Returns the attribute that marks a prim as a collider, ours first; or None.

    A PhysicsCollisionAPI on simulated cloth does not count.
    """
    own = [each.GetAttribute("warpcloth:collider") for each in holders(prim)]
    of_physics = [UsdPhysics.CollisionAPI(each) for each in holders(prim) if each.HasAPI(UsdPhysics.CollisionAPI)]
    of_physics = [] if has_api(prim, "PhysicsSurfaceDeformableSimAPI") else of_physics
    found = [each for each in own if each and each.HasAuthoredValue()]
    return next(iter([*found, *(each.GetCollisionEnabledAttr() for each in of_physics)]), None)


def collides(prim):
    """Returns whether a prim is a collider; refuses marked prims that are no shape."""
    mark = _mark(prim)
    if mark and mark.ValueMightBeTimeVarying():
        raise ValueError(f"{mark.GetName()} changes over time, must have one value")
    if mark is None or not mark.Get(Usd.TimeCode.EarliestTime()):
        return False
    below = prim.GetFilteredChildren(Usd.TraverseInstanceProxies())
    own = mark.GetPrim() == prim
    if own and not any(each.IsA(UsdGeom.Gprim) and prim in holders(each) for each in (prim, *below)):
        kind = prim.GetTypeName() or "untyped"
        raise ValueError(f"is {kind} without a shape right below it, must be a shape to be a collider")
    return prim.IsA(UsdGeom.Gprim)


class _Reader:
    """Reads the collider of a prim at the time codes of the frames."""

    def __init__(self, stage, prim, surroundings, codes):
        self.prim, self.kind, self.path = prim, str(prim.GetTypeName()), surroundings.path
        self.values = Values(stage, prim, "collider")
        self.metres = surroundings.meters_per_unit
        sampled = [] if self.kind == "Plane" else self._shape_codes
        self.codes = codes([*space_codes(prim), *sampled])

    @cached_property
    def _shape_codes(self):
        found = [self.prim.GetAttribute(name) for name in (*_SIZES, "points", "warpcloth:points")]
        codes = [time_codes_of(each) for each in found if each]
        return sorted({code for each in codes if len(each) > 1 for code in each})

    def collider(self):
        approximation = self._approximation()
        self._warn_of_dynamics()
        given = {"friction": self._friction(), "name": self._name()}
        size = None if self._shape_codes else self._size
        pose = self._rigid
        if pose is not None:
            scale, positions, rotations = pose
            given |= {"position": _alone(positions), "rotation": _alone(rotations)}
            if self.kind == "Plane":
                return Plane(normal=np.linalg.solve(scale, self._axis), **given)
            diagonal = np.diagonal(scale)
            straight = (np.abs(scale - np.diag(diagonal)) <= _SAME * np.abs(scale).max()).all()
            lengths = np.abs(diagonal)
            even, factor = straight and np.ptp(lengths) <= _SAME * lengths.max(), float(lengths[0])
            if self.kind == "Sphere" and even and size is not None:
                return Sphere(radius=factor * size["radius"], **given)
            if self.kind == "Capsule" and even and size is not None:
                radius, length = factor * size["radius"], factor * size["height"]
                return (
                    Capsule(radius=radius, length=length, axis=self._axis, **given)
                    if length
                    else Sphere(radius=radius, **given)
                )
            if self.kind == "Cube" and straight and size is not None:
                return Box(size=lengths * size["size"], **given)
        elif self.kind == "Plane":
            raise ValueError("is a Plane whose scale changes over time, must keep it to be a collider")
        return self._mesh(approximation, given)

    def _warn_of_dynamics(self):
        body = self.prim
        while body and not body.HasAPI(UsdPhysics.RigidBodyAPI):
            body = body.GetParent()
        body = body and UsdPhysics.RigidBodyAPI(body)
        if body and body.GetRigidBodyEnabledAttr().Get() and not body.GetKinematicEnabledAttr().Get():
            self._warn("is a rigid body that is not kinematic; it is taken as one, which only its animation moves")

    def _warn(self, text):
        warnings.warn(f"{self.path}, prim {self.prim.GetPath()}: {text}", stacklevel=2)

    def _friction(self):
        """Returns our coefficient of friction, else that of the material, dynamic before static."""
        said, static = next(self.values.authored("colliders.friction"), None), self.values.get("(static friction)")
        if said is None:
            return float(static or 0.0)
        friction = float(self.values.get("colliders.friction"))
        if static is not None and said[0].location != "collider" and static != friction:
            self._warn(f"its static friction {static:g} is not read; a collider has one friction, the dynamic {friction:g}")
        return friction

    def _name(self):
        """Returns our name (None if empty), else the path."""
        name = self.values.get("colliders.name")
        return str(self.prim.GetPath()) if name is None else name or None

    @property
    def _axis(self):
        return np.eye(3)["XYZ".index(token_of(self.prim.GetAttribute("axis"), ("X", "Y", "Z")))]

    @property
    def _size(self):
        found = {}
        for name in _SIZES:
            attribute = self.prim.GetAttribute(name)
            if attribute:
                found[name] = value_of(attribute, Usd.TimeCode.EarliestTime())
                refuse_unknown(name, np.array(found[name]))
                if found[name] < 0 or (found[name] == 0 and (self.kind, name) != ("Capsule", "height")):
                    raise ValueError(f"{name} is {found[name]}, must be above 0")
        return found

    @cached_property
    def _transforms(self):
        """The transforms (4, 4) to metres at each frame, or one.

        A scale of 0 shrinks a collider to a point, which hides it.
        """
        if not moving_space(self.prim):
            return [local_to_metres(self.prim, "")]
        found = [local_to_metres(self.prim, f"time code {code:g}", code, shrinks=True) for code in self.codes]
        if not any(each[:3, :3].any() for each in found):
            raise ValueError("is scaled to 0 at all frames, must be larger at some or be turned off with warpcloth:collider")
        return found

    @cached_property
    def _rigid(self):
        """Scale S (3, 3), positions t (F, 3) [m] and quaternions (F, 4) with x = rotate(p·S) + t, or None.

        Values of translate, orient and scale, as of `gprims`, are returned unchanged.
        """
        said = self._said
        if said is not None:
            return said
        linear = np.array([each[:3, :3] for each in self._transforms])
        if not linear.any(axis=(1, 2)).all():
            return None
        u, sizes, vt = np.linalg.svd(linear[0])
        turn, scale = u @ vt, (u * sizes) @ u.T
        if np.linalg.det(turn) < 0.0:
            turn, scale = -turn, -scale
        turns = np.linalg.solve(scale, linear)
        errors = np.abs(turns @ turns.transpose(0, 2, 1) - np.eye(3))
        if errors.max() > _SAME or (np.linalg.det(turns) < 0.0).any():
            return None
        from scipy.spatial.transform import Rotation  # loaded late, as importing this package stays light

        rotations = Rotation.from_matrix(turns.transpose(0, 2, 1)).as_quat()
        return scale, np.array([each[3, :3] for each in self._transforms]), rotations

    @property
    def _said(self):
        """Like :attr:`_rigid`, for a prim in world space and metres with translate, orient and scale."""
        shape = UsdGeom.Xformable(self.prim)
        operations = {each.GetOpType(): each for each in shape.GetOrderedXformOps()}
        order = [UsdGeom.XformOp.TypeTranslate, UsdGeom.XformOp.TypeOrient, UsdGeom.XformOp.TypeScale]
        if [*operations] != order[: len(operations)] or len(operations) < 2 or self.metres != 1.0:
            return None
        above = np.array(UsdGeom.XformCache(Usd.TimeCode.EarliestTime()).GetParentToWorldTransform(self.prim))
        if moving_space(self.prim.GetParent()) or not np.array_equal(above, np.eye(4)):
            return None
        scale = operations.get(order[2])
        if len(operations) != len(shape.GetOrderedXformOps()) or (scale and scale.MightBeTimeVarying()):
            return None
        codes = self.codes if moving_space(self.prim) else [Usd.TimeCode.EarliestTime()]
        positions = np.array([operations[order[0]].Get(code) for code in codes], dtype=np.float64)
        turns = [operations[order[1]].Get(code) for code in codes]
        rotations = np.array([[*each.GetImaginary(), each.GetReal()] for each in turns], dtype=np.float64)
        sizes = np.array(scale.Get(Usd.TimeCode.EarliestTime()) if scale else (1, 1, 1), dtype=np.float64)
        if not (
            sizes.all()
            and np.isfinite([*sizes, *positions.ravel()]).all()
            and (np.abs((rotations**2).sum(axis=1) - 1.0) < _SAME).all()
        ):
            return None  # the general case refuses it
        return np.diag(sizes), positions, rotations

    def _mesh(self, approximation, given):
        prim = self.prim
        if not (prim.IsA(UsdGeom.Mesh) or self.kind in SOLIDS):
            raise ValueError(f"is {self.kind}, must be a Mesh or one of {', '.join(SOLIDS)} to be a collider")
        points, triangles = self._surface()
        if self._rigid is not None:
            scale = self._rigid[0]
            points = points if np.array_equal(scale, np.eye(3)) else points @ scale
            mirrored = np.linalg.det(scale) < 0.0
        else:
            count = len(self.codes)
            points = np.broadcast_to(points, (count, *points.shape[-2:])) if points.ndim == 2 or len(points) == 1 else points
            points = np.stack([placed(*pair) for pair in zip(points, self._transforms, strict=True)])
            mirrored = any(np.linalg.det(each[:3, :3]) < 0.0 for each in self._transforms)
        triangles = without_slivers(first_extended(points), triangles)
        triangles = triangles[:, ::-1] if mirrored else triangles
        return self._approximated(approximation, points, triangles, given)

    def _surface(self):
        """Returns points (n, 3) or (F, n, 3) in the prim's space, and triangles (T, 3) counter-clockwise there."""
        codes = self.codes if self._shape_codes else [Usd.TimeCode.EarliestTime()]
        if self.kind in SOLIDS:
            self._size  # noqa: B018 (checks the sizes)
            solids = [SOLIDS[self.kind](self.prim, code) for code in codes]
            return _alone(np.array([each.vertices for each in solids])), np.array(solids[0].faces)
        refuse_moving_topology(self.prim)
        points = [self._points_at(code) for code in codes]
        for code, row in zip(codes, points, strict=True):
            if len(row) != len(points[0]):
                raise ValueError(f"points has {len(row)} points at time code {code:g}, must keep {len(points[0])}")
        corners, triangles = face_corners(self.prim, first_extended(np.array(points)))
        return _alone(np.array(points)), corners[triangles]

    def _points_at(self, code):
        points = array_of(UsdGeom.PointBased(self.prim).GetPointsAttr(), (3,), time=code)
        if points is None or not len(points):
            raise ValueError("has no points" + ("" if self.codes == [code] else f" at time code {code}"))
        refuse_unknown("points", points)
        own = self.prim.GetAttribute("warpcloth:points")
        exact = array_of(own, (3,), time=code) if own and own.HasAuthoredValue() else None
        same = exact is not None and np.array_equal(exact.astype(np.float32), points.astype(np.float32))
        return exact if same else points.astype(np.float64)

    def _approximation(self):
        own = self.values.get("(collides)")
        name = "warpcloth:collider" if isinstance(own, str) else "physics:approximation"
        wanted = own if isinstance(own, str) else self.values.get("(approximation)") or "none"
        if wanted not in (*_APPROXIMATIONS, *_TAKEN_AS_NONE):
            also = "true, false or " if isinstance(own, str) else ""
            raise ValueError(f"{name} is {wanted!r}, must be {also}one of {', '.join((*_APPROXIMATIONS, *_TAKEN_AS_NONE))}")
        return wanted

    def _approximated(self, wanted, points, triangles, given):
        if wanted in _TAKEN_AS_NONE or (wanted != "none" and points.ndim == 3):
            reason = "it deforms" if points.ndim == 3 else "it is not approximated in that way"
            self._warn(f"its approximation {wanted} is taken as none, as {reason}: its triangles are the collider")
            wanted = "none"
        if wanted == "none":
            found = MeshCollider(points=points, triangles=triangles, **given)
            if found.faces_inwards:
                self._warn("its triangles face inwards, so that what they enclose is free and all else is solid")
            return found
        if wanted == "convexHull":
            points, triangles = _hull(points)
            return MeshCollider(points=points, triangles=triangles, **given)
        if wanted == "boundingCube":
            low, high = points.min(axis=0), points.max(axis=0)
            return Box(size=high - low, **given | self._shifted(0.5 * (low + high), given))
        centre = _centre(points)
        radius = float(np.linalg.norm(points - centre, axis=1).max())
        return Sphere(radius=radius, **given | self._shifted(centre, given))

    def _shifted(self, centre, given):
        from scipy.spatial.transform import Rotation

        return {"position": given["position"] + Rotation.from_quat(given["rotation"]).apply(centre)}


def _alone(values):
    return values[0] if len(values) == 1 else values


def _hull(points):
    """Returns points (n, 3) and outward triangles (T, 3) of the convex hull."""
    from scipy.spatial import ConvexHull, QhullError  # loaded late, as importing this package stays light

    try:
        hull = ConvexHull(points)
    except QhullError:
        raise ValueError("its points are in a plane, must have a volume for a convexHull") from None
    a, b, c = points[hull.simplices].transpose(1, 0, 2)
    inwards = np.einsum("ti,ti->t", np.cross(b - a, c - a), hull.equations[:, :3]) < 0.0
    triangles = np.where(inwards[:, None], hull.simplices[:, ::-1], hull.simplices)
    used, triangles = np.unique(triangles, return_inverse=True)
    points, triangles = points[used], triangles.reshape(-1, 3)
    return points, without_slivers(points, triangles)


def _centre(points):
    import trimesh
    from scipy.spatial import QhullError

    try:
        return np.asarray(trimesh.nsphere.minimum_nsphere(points)[0])
    except QhullError:  # points in a plane
        return 0.5 * (points.min(axis=0) + points.max(axis=0))
