"""The loop of iterative methods that minimise, and the scale of their residuals."""

from typing import NamedTuple

import numpy as np

from ..core.status import Result
from ..kernels.terms.air import AIR
from ..mesh.mesh import areas_of
from ..model.host_values import host_values


class Ended(NamedTuple):
    """How the iterations of each copy ended.

    Attributes:
        results: A :class:`Result` of each copy, a list of B.
        residual: The last residual of each copy, (B,).
        iterations: Number of iterations.
    """

    results: list
    residual: np.ndarray
    iterations: int


def iterate(method, tolerance, iterations):
    """Iterates until each copy has converged, diverged or cannot improve, or the iterations are used up.

    Args:
        method: An object with the ``model`` and three functions:

            - ``start()`` sets the first iterate.
            - ``measure()`` returns the residual (B,) of the iterate, not finite in a copy that diverged, and a dict from other
              :class:`Result` values to booleans (B,), which copies end with them.
            - ``iterate(active)`` does one iteration of the active copies, (B,) booleans.

        tolerance: The residual at which a copy has converged.
        iterations: Maximum number of iterations.

    Returns:
        :class:`Ended`. A copy that has ended keeps its residual and its result.
    """
    method.start()
    copies = method.model.copies
    active, residual = np.ones(copies, dtype=bool), np.zeros(copies)
    results = [Result.ITERATIONS_USED_UP] * copies
    done = 0
    while True:
        now, others = method.measure()
        residual = np.where(active, now, residual)
        ways = {Result.DIVERGED: ~np.isfinite(residual), Result.CONVERGED: residual <= tolerance, **others}
        for result, ended in ways.items():
            for copy in np.flatnonzero(active & ended):
                results[copy] = result
            active &= ~ended
        if not active.any() or done == iterations:
            return Ended(results, residual, done)
        method.iterate(active)
        done += 1


class ResidualScale:
    """The acceleration by which the residuals of each copy are divided, which no force of the motion changes.

    It is g + (F + W)/M, with M the mass of the free vertices. F = max_t Σ‖f‖ is the largest load, pressures on the rest shape,
    and W = Σ½ρA max(C_n, C_t)w² the force of the largest wind across the cloth. Where all of these are 0, it is R/T², with the
    radius R of the rest shape about its mean and the duration T of the scene. An error of ε R/T² that always acts one way moves
    a free cloth by εR/2 in this time, whatever the step.

    Args:
        model: The :class:`warpcloth.model.model.Model`.

    Attributes:
        driven: g + (F + W)/M, (B,) [m/s²].
        acceleration: (B,) [m/s²], above 0.
        units: A text (B,) for each copy, such as "times gravity".
    """

    def __init__(self, model):
        gravity = np.linalg.norm(model.gravity.numpy().astype(np.float64), axis=1)
        mass, inverse = (each.numpy().astype(np.float64).reshape(model.copies, -1) for each in (model.mass, model.inverse_mass))
        free = inverse > 0.0
        total = _summed(np.where(free, mass, 0.0))
        parts = {"gravity": gravity, "loads": _loads(model, free), "wind": _wind(model, free)}
        for name in ("loads", "wind"):
            parts[name] = np.divide(parts[name], total, out=np.zeros(model.copies), where=total > 0.0)
        self.driven = driven = sum(parts.values())
        points = np.sort(model.rest_points, axis=0)  # a sum that the numbering of the vertices does not change
        radius = np.linalg.norm(model.rest_points - points.mean(axis=0), axis=1).max()
        duration = float(model.scene.duration)
        self.acceleration = np.where(driven > 0.0, driven, (radius or 1.0) / duration**2)
        self.units = [_unit([name for name, part in parts.items() if part[copy] > 0.0]) for copy in range(model.copies)]


def _unit(names):
    if not names:
        return "times the radius of the cloth over the square of the duration"
    return f"times {' + '.join(names)}{'' if names == ['gravity'] else ' per mass'}"


def _loads(model, free):
    """Returns the largest Σ‖f‖ of the loads on the ``free`` vertices (B, n) of each copy, (B,) [N]."""
    if model.loads is None:
        return np.zeros(model.copies)
    dead, pressed = model.loads.dead, model.loads.pressed
    forces = np.linalg.norm(dead.keyframes.numpy().astype(np.float64), axis=3)
    found = _summed(forces * free[:, dead.vertices.numpy()]).max(axis=0)
    if model.loads.follows:
        triangles, pressure = pressed.triangles.numpy(), np.abs(pressed.keyframes.numpy().astype(np.float64))
        found += _summed(pressure * _free_areas(model, free, triangles)).max(axis=0)
    return found


def _wind(model, free):
    """Returns the largest force of the wind across the triangles of each copy, (B,) [N]."""
    found, air = np.zeros(model.copies), model.scene.air
    for elements in model.terms:
        if elements.term is AIR:
            elements = elements.by_copies(model)
            density, rest = (
                host_values(each).astype(np.float64).reshape(model.copies, elements.per_copy, -1)
                for each in (elements.stiffness, elements.rest)
            )
            speed = air.speed if air.changes else np.linalg.norm(rest[..., 8:11], axis=2)
            pressure = 0.5 * density[..., 0] * rest[..., 11:13].max(axis=2) * speed**2
            found += _summed(pressure * _free_areas(model, free, elements.stencil.numpy()[: elements.per_copy]))
    return found


def _free_areas(model, free, triangles):
    """Returns the rest areas (B, T) of triangles (T, 3), of each the share of its free corners [m²]."""
    return areas_of(model.rest_points, triangles) * free[:, triangles].mean(axis=2)


def _summed(values):
    """Returns sums over the last axis, which the order of the values does not change."""
    return np.sort(values, axis=-1).sum(axis=-1)
