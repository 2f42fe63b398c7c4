"""Kernels over contact with colliders that skip elements without force.

``clear`` is the distance that the vertex of an element can move from x̃ without a force [m].
"""

from functools import cache

import warp as wp

from ..assemble import is_clear, of_element
from ..local import local_coordinate
from ..memory import load, load_shared
from ..term import Term
from ..terms import contact
from ..vectors import types


@cache
def find_clear(term: Term, dtype):
    """Kernel over elements: clear at x̃, from the rest states of the step."""
    vec3, _ = types(dtype)
    rest_type = wp.types.vector(term.parameters, dtype)
    y_of, clearance, rest_of = local_coordinate(term, dtype, False), term.clearance, load(rest_type)

    @wp.kernel(module="unique", enable_backward=False)
    def find(
        # elements
        stencil: wp.array2d(dtype=wp.int32),
        rest: wp.array(dtype=rest_type),
        # state in
        x: wp.array(dtype=vec3),
        # out
        clear: wp.array(dtype=dtype),
    ):
        e = wp.tid()
        r = rest_of(rest, e)
        clear[e] = clearance(y_of(stencil, e, r, x, x), r)

    return find


@cache
def move_clear(term: Term, dtype):
    """Kernel over contact elements: x[vertex] += max(r − d, 0) ∇d. Pins stay. No two elements of a term share a vertex."""
    vec3, _ = types(dtype)
    rest_type = wp.types.vector(term.parameters, dtype)
    y_of, gap, rest_of = local_coordinate(term, dtype, False), term.gap, load(rest_type)

    @wp.kernel(module="unique", enable_backward=False)
    def move(
        # elements
        stencil: wp.array2d(dtype=wp.int32),
        rest: wp.array(dtype=rest_type),
        inverse_mass: wp.array(dtype=dtype),
        # in and out
        x: wp.array(dtype=vec3),
    ):
        e = wp.tid()
        i = stencil[e, 0]
        r = rest_of(rest, e)
        d, n = gap(y_of(stencil, e, r, x, x), r)
        if inverse_mass[i] > dtype(0.0) and d < r[contact.DISTANCE]:
            x[i] = x[i] + (r[contact.DISTANCE] - d) * n

    return move


# A secant ends at LEAP d, or at LIFT r if that is more, at most.
LEAP, LIFT = wp.constant(10.0), wp.constant(0.04)


@cache
def add_hessian(term: Term, dtype):
    """Kernel over elements: values[diagonal[vertex]] += kₑ Aₑ ∂²u/∂y² [N/m], semi-definite; of contact kA c nnᵀ.

    Newton's method with c = φ″ at most doubles a small d. So c is the slope of a secant of φ′ from d to the distance that the
    vertex would have with its own ``inertia`` m/h² [N/m] and the other forces in ``gradient`` ∇φ [N], or less. At the minimum
    this is φ″. A secant is no upper bound, so ``careful`` copies use φ″. ``diagonal`` is negative for pins. No two elements
    share a vertex.
    """
    vec3, mat33 = types(dtype)
    rest_type = wp.types.vector(term.parameters, dtype)
    y_of, rest_of, number = local_coordinate(term, dtype, True), load(rest_type), load_shared(dtype)
    (_energy, _gradient, hessian_of), measure, gap = of_element(term, dtype, True), term.measure, term.gap
    slope, bend, gap_after = contact.slope, contact.bend, contact.gap_after

    @wp.kernel(module="unique", enable_backward=False)
    def add(
        # elements
        stencil: wp.array2d(dtype=wp.int32),
        stiffness: wp.array(dtype=dtype),
        rest: wp.array(dtype=rest_type),
        clear: wp.array(dtype=dtype),
        diagonal: wp.array(dtype=wp.int32),
        # state in
        x: wp.array(dtype=vec3),
        d: wp.array(dtype=vec3),
        gradient: wp.array(dtype=vec3),
        # parameters
        inertia: wp.array(dtype=dtype),
        careful: wp.array(dtype=wp.int32),
        per_copy: int,
        # in and out
        values: wp.array(dtype=mat33),
    ):
        e = wp.tid()
        i = stencil[e, 0]
        slot = diagonal[i]
        if slot < 0:
            return
        if clear.shape[0] > 0:
            if is_clear(clear[e], d[i]):
                return
        r = rest_of(rest, e)
        if wp.static(term.gap is None):
            values[slot] = values[slot] + hessian_of(stencil, stiffness, e, r, x, d, dtype(0.0))
        else:
            distance = r[11]
            now, n = gap(y_of(stencil, e, r, x, d), r)
            if now <= distance:
                k = number(stiffness, e) * measure(r)
                curvature = bend(now, distance)
                if careful[i // per_copy] == 0 and inertia[i] > dtype(0.0):
                    others = wp.dot(gradient[i], n) - k * slope(now, distance)
                    after = gap_after(now - others / inertia[i], distance, k / inertia[i])
                    after = wp.min(after, wp.max(dtype(LEAP) * now, dtype(LIFT) * distance))
                    if after > dtype(1.001) * now:
                        curvature = (slope(after, distance) - slope(now, distance)) / (after - now)
                values[slot] = values[slot] + (k * curvature) * wp.outer(n, n)

    return add
