"""The local problem of an element, argmin u(z) + ½r‖v − z‖², of ADMM and of XPBD."""

from functools import cache
from typing import Any

import warp as wp

from .rotation import epsilon
from .term import Term

# Maximum number of halvings of a Newton step.
HALVINGS = wp.constant(30)


@wp.func
def solve_definite(H: Any, b: Any, n: int):
    """H⁻¹ b for a symmetric positive definite H of n rows, by Cholesky."""
    L = H
    x = b
    for j in range(n):
        s = L[j, j]
        for k in range(j):
            s -= L[j, k] * L[j, k]
        s = wp.sqrt(s)
        L[j, j] = s
        for i in range(j + 1, n):
            t = L[i, j]
            for k in range(j):
                t -= L[i, k] * L[j, k]
            L[i, j] = t / s
    for i in range(n):
        t = x[i]
        for k in range(i):
            t -= L[i, k] * x[k]
        x[i] = t / L[i, i]
    for step in range(n):
        i = n - 1 - step
        t = x[i]
        for k in range(i + 1, n):
            t -= L[k, i] * x[k]
        x[i] = t / L[i, i]
    return x


@cache
def local_minimiser(term: Term, dtype):
    """Device function (v, z, rest, r, steps) → argmin u(z) + ½r‖v − z‖², r > 0, from the guess z.

    It is a term's prox, or (p(v) + r v)/(1 + r) of its projection, else Newton's method with a semi-definite Hessian and a line
    search. It is NaN if a force or energy is not finite, or r is so small that the Hessian is not definite.
    """
    rest_type, y_type = wp.types.vector(term.parameters, dtype), wp.types.matrix((term.rows, 3), dtype)
    flat = wp.types.vector(3 * term.rows, dtype)
    size = wp.constant(3 * term.rows)
    project, prox, prox_from = term.project, term.prox, term.prox_from
    u, gradient, hessian = term.energy, term.gradient, term.hessian

    @wp.func
    def closed(v: y_type, z: y_type, rest: rest_type, r: dtype, steps: int):
        return v + (project(v, rest) - v) / (dtype(1.0) + r)

    @wp.func
    def by_prox(v: y_type, z: y_type, rest: rest_type, r: dtype, steps: int):
        if wp.static(prox_from is None):
            p = prox(v, rest, dtype(1.0) / r)
        else:
            p = prox_from(z, v, rest, dtype(1.0) / r)
        return p

    @wp.func
    def value(v: y_type, z: y_type, rest: rest_type, r: dtype):
        return u(z, rest) + dtype(0.5) * r * wp.ddot(v - z, v - z)

    @wp.func
    def newton(v: y_type, z: y_type, rest: rest_type, r: dtype, steps: int):
        n = steps - steps + size  # unknown to the compiler, or it would unroll
        now = value(v, z, rest, r)
        other = value(v, v, rest, r)
        if not (now <= other):
            z = v
            now = other
        for _step in range(steps):
            g = gradient(z, rest) + r * (z - v)
            right = flat()
            for i in range(n):
                right[i] = -g[i // 3, i % 3]
            H = hessian(z, rest, dtype(0.0))
            for i in range(n):
                H[i, i] = H[i, i] + r
            p = solve_definite(H, right, n)
            slope = -wp.dot(right, p)
            direction = y_type()
            for i in range(n):
                direction[i // 3, i % 3] = p[i]
            if not (wp.dot(p, p) > dtype(64.0) * epsilon(r) * epsilon(r) * wp.ddot(z, z)):
                return z + (direction - direction) + (g - g) + (now - now) * z
            t = dtype(1.0)
            halvings = steps - steps  # 0, and no constant, so that it may change in the loop
            searching = halvings == 0
            while searching:
                after = value(v, z + t * direction, rest, r)
                # Near the minimum rounding hides the decrease of u, so it may rise by some roundings.
                if after <= now + dtype(1.0e-4) * t * slope + dtype(4.0) * epsilon(r) * wp.abs(now):
                    z = z + t * direction
                    now = after
                    searching = False
                else:
                    t = dtype(0.5) * t
                    halvings += 1
                    if halvings > HALVINGS:
                        return z + (now - now) * z
        return z + (now - now) * z

    if prox is not None:
        return by_prox
    return closed if project is not None else newton
