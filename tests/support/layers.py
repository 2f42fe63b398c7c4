"""Sheets above one another, and scenes and steps of them."""

import numpy as np

import warpcloth as wc

DENSITY, GRAVITY = 0.15, 9.81
R = 1e-3  # the contact distance of what is falling


def turned(points, angle):
    """Points (n, 3), turned about the y axis through their middle [rad], which goes to the origin."""
    c, s = np.cos(angle), np.sin(angle)
    return (points - points.mean(axis=0)) @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def stack(count, n, size, gap=0.0, turn=0.0, shrink=1.0, **grid):
    """A mesh of ``count`` square grids, each raised by ``gap`` over the last, turned by ``turn`` [rad] more, and smaller."""
    sheet = wc.Mesh.grid(n, n, size=size, **grid)
    points = [shrink**k * turned(sheet.points, turn * k) + [0.0, gap * k, 0.0] for k in range(count)]
    return wc.Mesh(np.concatenate(points), np.concatenate([sheet.triangles + k * n * n for k in range(count)]))


def cloth(mesh, stiffness=100.0, bending=1e-5, **fields):
    """A scene of a mesh with springs and bending."""
    terms = [wc.Spring(stiffness=stiffness), wc.QuadraticBending(stiffness=bending)]
    return wc.Scene(mesh, **{"density": DENSITY, "terms": terms} | fields)


def falling(colliders, speed=1.0, fps=24.0, n=6, stiffness=100.0, height=0.05, **fields):
    """A sheet of 0.5 m that falls, and drifts sideways."""
    grid = wc.Mesh.grid(n, n, size=0.5)
    given = {
        "positions": grid.points + np.array([0.0, height, 0.0]),
        "velocities": np.tile([0.3 * speed, -speed, 0.0], (n * n, 1)),
        "duration": 8.0 / fps,
        "contact": wc.Contact(distance=R, stiffness=10.0 * DENSITY * GRAVITY / R),  # explicit steps of 1/960 s are stable
    }
    return cloth(grid, stiffness, colliders=colliders, fps=fps, **given | fields)


def layers(count=2, n=6, gap=0.02, speed=0.0, turn=0.0, distance=5e-3, stiffness=1e5, size=0.5, shrink=1.0, **fields):
    """A :func:`stack`, ``turn`` in degrees, without gravity: the first sheet moves up at ``speed`` [m/s], the others down."""
    velocities = np.zeros((count * n * n, 3))
    velocities[:, 1] = np.where(np.arange(count * n * n) < n * n, speed, -speed)
    given = {
        "velocities": velocities,
        "gravity": np.zeros(3),
        "fps": 24.0,
        "self_contact": wc.SelfContact(distance=distance, stiffness=stiffness),
    }
    return cloth(stack(count, n, size, gap, np.radians(turn), shrink), **given | fields)


def folded(n=13, gap=0.02, closing=0.0, **fields):
    """A sheet of 0.5 m folded in two about a half circle, whose halves come together at a speed [m/s]."""
    grid, radius = wc.Mesh.grid(n, n, size=0.5), 0.5 * gap + 0.03
    s, half = grid.points[:, 0] - 0.25, 0.5 * np.pi * radius
    bent = np.abs(s) < half
    x = np.where(bent, radius * np.cos(s / radius), half - np.abs(s))
    y = np.where(bent, radius * np.sin(s / radius), np.sign(s) * radius)
    return cloth(
        grid,
        terms=[wc.Spring(stiffness=100.0, pairs=("structural", "shear")), wc.QuadraticBending(stiffness=1e-5)],
        positions=np.stack([x, y, grid.points[:, 2]], axis=1),
        velocities=-closing * np.sign(y)[:, None] * [0.0, 1.0, 0.0],
        fps=24.0,
        self_contact=wc.SelfContact(distance=5e-3, stiffness=1e4),
        **fields,
    )


def rubbing(gap=2.2e-3, speed=0.05, friction=0.3, **fields):
    """Two free sheets, pressed together at a gap below the contact distance of 5 mm, that rub against each other."""
    velocities = np.where(np.arange(32)[:, None] < 16, speed, -speed) * [1.0, 0.0, 0.0]
    contact = wc.SelfContact(distance=5e-3, stiffness=1e3, friction=friction)
    return layers(n=4, gap=gap, turn=np.degrees(0.3), velocities=velocities, self_contact=contact, **fields)


def slope(tangent, friction=0.3, layers=1, distance=2e-3, **fields):
    """Free sheets of 3 × 3 vertices, each turned against the last, on two pinned triangles, in gravity that is tilted."""
    angle, grid, ground = np.arctan(tangent), wc.Mesh.grid(3, 3, size=0.25), wc.Mesh.grid(2, 2, size=1.0)
    weight = DENSITY * GRAVITY * np.cos(angle)
    stiffness, y, points, triangles = 10.0 * DENSITY * GRAVITY / distance, 0.0, [ground.points], [ground.triangles]
    for layer in range(layers):
        y += distance - (layers - layer) * weight / stiffness  # where it rests
        points.append(turned(grid.points, 0.3 * layer + 0.3) + ground.points.mean(axis=0) + [-0.2, y, 0.013])
        triangles.append(grid.triangles + 4 + 9 * layer)
    return cloth(
        wc.Mesh(np.concatenate(points), np.concatenate(triangles)),
        bending=1e-4,
        pins=np.arange(4),
        gravity=GRAVITY * np.array([np.sin(angle), -np.cos(angle), 0.0]),
        fps=24.0,
        self_contact=wc.SelfContact(distance=distance, stiffness=stiffness, friction=friction),
        **fields,
    )


def ground(side, cells=2, **fields):
    """A flat mesh of ``cells`` vertices per side at y = 0, with its middle at the origin."""
    grid = wc.Mesh.grid(cells, cells, size=side)
    return wc.MeshCollider(grid.points - [0.5 * side, 0.0, 0.5 * side], grid.triangles, **fields)


def positions(stepper, frames):
    """Yields the positions (N, 3) after each of some frames."""
    for _ in range(frames):
        stepper.frame()
        yield stepper.state.x.numpy().copy()
