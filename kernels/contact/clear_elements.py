"""Factories of CPU kernels over contact with colliders: elements of one vertex, most of which have no force.

``clear`` is the distance that the vertex of an element can move from x̃ without a force [m]. It is 0 or less where a force is
possible at x̃. Elements with a shorter correction d are skipped before their rest state is read.
"""

from functools import cache
from typing import Any

import warp as wp

from ..assemble import of_element
from ..local import local_coordinate
from ..memory import load
from ..term import HessianPolicy, Term
from ..vectors import types

CLAMP = wp.constant(int(HessianPolicy.CLAMP))


@wp.func
def is_clear(radius: Any, d: Any):
    """Whether ‖d‖ is below the radius; False if d is not finite or the radius is NaN."""
    return radius > type(radius)(0.0) and wp.dot(d, d) < radius * radius


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
def add_energy(term: Term, dtype):
    """Kernel of one thread: out[copy] += Σ kₑ Aₑ u(yₑ) [J], in double precision."""
    vec3, _ = types(dtype)
    rest_type = wp.types.vector(term.parameters, dtype)
    (energy_of, _gradient, _hessian), rest_of = of_element(term, dtype, True), load(rest_type)

    @wp.kernel(module="unique", enable_backward=False)
    def add(
        # elements
        stencil: wp.array2d(dtype=wp.int32),
        stiffness: wp.array(dtype=dtype),
        rest: wp.array(dtype=rest_type),
        clear: wp.array(dtype=dtype),
        # state in
        x: wp.array(dtype=vec3),
        d: wp.array(dtype=vec3),
        # parameters
        per_copy: int,
        # in and out
        out: wp.array(dtype=wp.float64),
    ):
        for e in range(stencil.shape[0]):
            if not is_clear(clear[e], d[stencil[e, 0]]):
                value = energy_of(stencil, stiffness, e, rest_of(rest, e), x, d)
                out[e // per_copy] = out[e // per_copy] + value

    return add


@cache
def add_gradient(term: Term, dtype):
    """Kernel of one thread: out[vertex] += kₑ Aₑ ∂u/∂y [N]."""
    vec3, _ = types(dtype)
    rest_type = wp.types.vector(term.parameters, dtype)
    (_energy, gradient_of, _hessian), rest_of = of_element(term, dtype, True), load(rest_type)

    @wp.kernel(module="unique", enable_backward=False)
    def add(
        # elements
        stencil: wp.array2d(dtype=wp.int32),
        stiffness: wp.array(dtype=dtype),
        rest: wp.array(dtype=rest_type),
        clear: wp.array(dtype=dtype),
        # state in
        x: wp.array(dtype=vec3),
        d: wp.array(dtype=vec3),
        # in and out
        out: wp.array(dtype=vec3),
    ):
        for e in range(stencil.shape[0]):
            i = stencil[e, 0]
            if not is_clear(clear[e], d[i]):
                out[i] = out[i] + gradient_of(stencil, stiffness, e, rest_of(rest, e), x, d)[0]

    return add


@cache
def add_hessian(term: Term, dtype):
    """Kernel over elements: out[vertex] += kₑ Aₑ ∂²u/∂y² [N/m], projected to semi-definite.

    It works on any device, for no two elements share a vertex. ``clear`` may be None.
    """
    vec3, mat33 = types(dtype)
    rest_type = wp.types.vector(term.parameters, dtype)
    (_energy, _gradient, hessian_of), rest_of = of_element(term, dtype, True), load(rest_type)

    @wp.kernel(module="unique", enable_backward=False)
    def add(
        # elements
        stencil: wp.array2d(dtype=wp.int32),
        stiffness: wp.array(dtype=dtype),
        rest: wp.array(dtype=rest_type),
        clear: wp.array(dtype=dtype),
        # state in
        x: wp.array(dtype=vec3),
        d: wp.array(dtype=vec3),
        # in and out
        out: wp.array(dtype=mat33),
    ):
        e = wp.tid()
        i = stencil[e, 0]
        if clear.shape[0] > 0:
            if is_clear(clear[e], d[i]):
                return
        out[i] = out[i] + hessian_of(stencil, stiffness, e, rest_of(rest, e), x, d, CLAMP)

    return add


@cache
def find_hessians(term: Term, dtype):
    """Kernel over elements of three vertices, with one row: kₑ Aₑ ∂²u/∂y² [N/m], semi-definite, and the weights of y."""
    vec3, mat33 = types(dtype)
    rest_type, weight = wp.types.vector(term.parameters, dtype), term.weight
    (_energy, _gradient, hessian_of), rest_of = of_element(term, dtype, True), load(rest_type)

    @wp.kernel(module="unique", enable_backward=False)
    def find(
        # elements
        stencil: wp.array2d(dtype=wp.int32),
        stiffness: wp.array(dtype=dtype),
        rest: wp.array(dtype=rest_type),
        # state in
        x: wp.array(dtype=vec3),
        d: wp.array(dtype=vec3),
        # out
        weights: wp.array(dtype=vec3),
        out: wp.array(dtype=mat33),
    ):
        e = wp.tid()
        r = rest_of(rest, e)
        w = vec3()
        for i in range(3):
            w[i] = weight(r, i)[0]
        weights[e] = w
        out[e] = hessian_of(stencil, stiffness, e, r, x, d, CLAMP)

    return find
