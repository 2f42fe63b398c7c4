"""Changes of a scene after which the motion is known from that before: other units, another observer, another numbering."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

import warpcloth as wc

# Exponents of length, time and mass in the unit of each field that has one. Records that a field holds have theirs.
UNITS = {
    wc.Scene: {
        "density": (-2, 0, 1),
        "positions": (1, 0, 0),
        "velocities": (1, -1, 0),
        "gravity": (1, -2, 0),
        "duration": (0, 1, 0),
        "fps": (0, -1, 0),
    },
    wc.Pins: {"keyframes": (1, 0, 0)},
    wc.Spring: {"stiffness": (0, -2, 1), "damping": (0, -1, 1)},
    wc.QuadraticBending: {"stiffness": (2, -2, 1), "damping": (2, -1, 1)},
    wc.Contact: {"distance": (1, 0, 0), "stiffness": (-2, -2, 1)},
    wc.SelfContact: {"distance": (1, 0, 0), "stiffness": (-2, -2, 1)},
    wc.Air: {"density": (-3, 0, 1), "wind": (1, -1, 0)},
    wc.Plane: {"position": (1, 0, 0)},
    wc.Sphere: {"position": (1, 0, 0), "radius": (1, 0, 0)},
    wc.Box: {"position": (1, 0, 0), "size": (1, 0, 0)},
    wc.MeshCollider: {"position": (1, 0, 0), "points": (1, 0, 0)},
}


def in_units(record, length, time, mass):
    """A scene, or a record of one, with lengths, times and masses that are so many times those of before."""
    factors = {name: length**L * time**T * mass**M for name, (L, T, M) in UNITS[type(record)].items()}
    values = {name: (factor, getattr(record, name)) for name, factor in factors.items()}
    changed = {name: factor * np.asarray(value) for name, (factor, value) in values.items() if value is not None}
    if isinstance(record, wc.Scene):
        changed["mesh"] = wc.Mesh(length * record.mesh.points, record.mesh.triangles)
        for name in ("pins", "contact", "self_contact", "air"):
            held = getattr(record, name)
            changed[name] = held if held is None else in_units(held, length, time, mass)
        for name in ("terms", "colliders"):
            changed[name] = [in_units(each, length, time, mass) for each in getattr(record, name)]
    return replace(record, **changed)


def seen(scene, turn=None, shift=(0.0, 0.0, 0.0), boost=(0.0, 0.0, 0.0)):
    """A scene for another observer: x becomes Qx + s + vt, with Q orthogonal (3, 3), a reflection too, and s [m], v [m/s].

    If v is not 0, pins and colliders that stand get keyframes.
    """
    Q = np.eye(3) if turn is None else turn
    shift, boost = np.array(shift), np.array(boost)
    # In the frame of a collider, of which those of closed form are symmetric: x becomes −x if Q is a reflection.
    side = np.diag([round(np.linalg.det(Q)), 1.0, 1.0])

    def led(points, rank):
        """Positions, or keyframes if their rank is ``rank``; keyframes from the first frame to the last if v is not 0."""
        moved = points @ Q.T + shift
        if not boost.any():
            return moved
        keyframes = moved if moved.ndim == rank else moved[None]
        frames = np.arange(scene.frames + 1)
        times = (frames / scene.fps).reshape(-1, *(1,) * (rank - 1))
        return keyframes[np.minimum(frames, len(keyframes) - 1)] + times * boost

    def as_moved(collider):
        turned = Q @ Rotation.from_quat(collider.rotation).as_matrix() @ side
        changed = {"position": led(collider.position, 2), "rotation": Rotation.from_matrix(turned).as_quat()}
        if isinstance(collider, wc.MeshCollider):
            changed["points"] = collider.points @ side
            changed["triangles"] = collider.triangles[:, :: int(side[0, 0])]  # fronts stay outside
        return replace(collider, **changed)

    pins, keyframes = scene.pins.vertices, scene.pins.keyframes
    if len(pins) and (keyframes is not None or boost.any()):
        keyframes = led(scene.positions[pins] if keyframes is None else keyframes, 3)
    return replace(
        scene,
        mesh=wc.Mesh(scene.mesh.points @ Q.T + shift, scene.mesh.triangles),
        positions=scene.positions @ Q.T + shift,
        velocities=scene.velocities @ Q.T + boost,
        gravity=scene.gravity @ Q.T,
        pins=wc.Pins(pins, keyframes),
        colliders=[as_moved(each) for each in scene.colliders],
        air=scene.air and replace(scene.air, wind=scene.air.winds @ Q.T + boost),
    )


def shuffled(triangles, random):
    """Triangles in another order, each from another of its corners on."""
    return np.array([np.roll(corners, random.integers(3)) for corners in random.permutation(triangles)])


def with_triangles_shuffled(scene, seed=0):
    """A scene whose triangles, and those of whose colliders, come in another order."""
    random = np.random.default_rng(seed)
    return replace(
        scene,
        mesh=wc.Mesh(scene.mesh.points, shuffled(scene.mesh.triangles, random)),
        colliders=[
            replace(each, triangles=shuffled(each.triangles, random)) if isinstance(each, wc.MeshCollider) else each
            for each in scene.colliders
        ],
    )


def renumbered(scene, seed=1):
    """A scene whose vertices, and those of whose colliders, have other numbers, and which vertex of before each is.

    Its terms name no vertices.
    """
    random = np.random.default_rng(seed)

    def numbers(count):
        order = random.permutation(count)
        return order, np.argsort(order)

    def of_collider(collider):
        if not isinstance(collider, wc.MeshCollider):
            return collider
        order, ranks = numbers(collider.points.shape[-2])
        return replace(collider, points=collider.points[..., order, :], triangles=ranks[collider.triangles])

    order, ranks = numbers(len(scene.positions))
    changed = replace(
        scene,
        mesh=wc.Mesh(scene.mesh.points[order], ranks[scene.mesh.triangles]),
        positions=scene.positions[order],
        velocities=scene.velocities[order],
        masses=None if scene.masses is None else scene.masses[order],
        pins=wc.Pins(ranks[scene.pins.vertices], scene.pins.keyframes),
        colliders=[of_collider(each) for each in scene.colliders],
    )
    return changed, order
