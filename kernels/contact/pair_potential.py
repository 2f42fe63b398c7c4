"""Kernels that find the contacts of a surface at given positions. Their potential is a function of positions alone.

U = Σᵥ ½ k aᵥ Σ_F m φ(d(v, F)) + Σ k (π/2) bₑ b_f φ(4 D(e, f)). The first sum is over vertices v, with rest area aᵥ, half for
each side, and the faces, edges and vertices F near v. The multiplicities m are those of inclusion and exclusion: 1 for a face,
1 − N for an edge of N near faces, and 1 + N − E for a vertex of N near faces with E edges there. The nearest point of a face
may be on its edge, so most terms cancel: over a plane or a convex edge one is left, over a valley two faces minus one edge. So
a flat sheet has the pressure −kφ′, and the gradient is continuous.

The second sum is over pairs of edges, because vertices do not find where two edges cross; b is the rest area of an edge over
its length. D² = min over s and t of ‖y(s, t)‖² (1 + ⅛((2s − 1)² + (2t − 1)²)) is strictly convex, so D has a gradient for
parallel edges too. Edges act below a quarter of the contact distance.

Elements with a common vertex have no contact, nor have those of one piece whose rest distance is below 2r. Against meshes,
vertices of cloth have their whole area, and vertices of meshes act on faces of cloth by k aᵥ φ(4d). Positions of meshes are not
unknowns, so y = Σ wᵢxᵢ + o with the vertices of the cloth alone.
"""

from functools import cache
from typing import Any

import warp as wp

from ..memory import load
from ..pairs import Layout, Pairs
from ..terms.contact import bend
from ..vectors import types
from .obstacles import cloth_vertex, has_obstacle, in_copy
from .self_gaps import CORNER, EDGE, INSIDE, ONE, SIDE, ZERO, along, gap_along, nearest_of_face, vertex_of, vertex_triangle
from .self_pairs import module_of, slot_with, take_slot

MIDDLE = wp.constant(wp.float64(0.125))  # weight of the distance from the middles of edges; below 1/6 D is strictly convex
CLOSE = wp.constant(wp.float64(0.25))  # contact distance of edges over that of vertices
TWO, HALF_PI = wp.constant(wp.float64(2.0)), wp.constant(wp.float64(1.5707963267948966))
SIX = wp.types.vector(6, wp.int32)
NONE, TWO_EDGES = wp.constant(-1), wp.constant(7)  # codes of a face that is not near, and of a pair of edges


@wp.func
def from_middles(p: wp.vec2d):
    """1 + ⅛((2s − 1)² + (2t − 1)²)."""
    m = TWO * p - wp.vec2d(ONE, ONE)
    return ONE + MIDDLE * wp.dot(m, m)


@wp.func
def on_two_edges(u: wp.vec3d, c: wp.vec3d, d: wp.vec3d):
    """(s, t) of D for the edges 0u and cd, by a projected Newton method with line search, and D/‖y‖."""
    v = c - d
    of_square = TWO * wp.mat22d(wp.dot(u, u), wp.dot(u, v), wp.dot(u, v), wp.dot(v, v))  # ∂²‖y‖²
    p = wp.vec2d(SIDE, SIDE)
    turn = wp.int32(0)
    while turn < 40:
        turn += 1
        y = p[0] * u + p[1] * v - c
        q = wp.dot(y, y)
        g = from_middles(p)
        dq = TWO * wp.vec2d(wp.dot(y, u), wp.dot(y, v))
        dg = wp.float64(4.0) * MIDDLE * (TWO * p - wp.vec2d(ONE, ONE))
        slope = g * dq + q * dg
        H = g * of_square + wp.outer(dq, dg) + wp.outer(dg, dq)
        for i in range(2):
            H[i, i] = H[i, i] + wp.float64(8.0) * MIDDLE * q
        for i in range(2):
            if (p[i] <= ZERO and slope[i] > ZERO) or (p[i] >= ONE and slope[i] < ZERO):  # it stays
                slope[i] = ZERO
                H[0, 1] = ZERO
                H[1, 0] = ZERO
        move = wp.inverse(H) * slope
        step = ONE
        after = wp.vec2d(p[0], p[1])
        tries = wp.int32(0)
        while tries < 20:
            after = wp.vec2d(wp.clamp(p[0] - step * move[0], ZERO, ONE), wp.clamp(p[1] - step * move[1], ZERO, ONE))
            y = after[0] * u + after[1] * v - c
            if wp.dot(y, y) * from_middles(after) <= g * q * (ONE + wp.float64(1e-13)):
                tries = 20
            step *= SIDE
            tries += 1
        if wp.max(wp.abs(after - p)) < wp.float64(1e-15):
            turn = 40
        p = wp.vec2d(after[0], after[1])
    return p, wp.sqrt(from_middles(p))


@wp.struct
class Followed:
    """The ``start`` of λ where contacts are found anew, and the λ ``carried`` over from the previous contacts.

    The other arrays are those of the previous contacts. ``mode`` (1,) is 0 in a sweep, STARTING if it only adds the start, and
    ENDING if it only removes the forces.
    """

    mode: wp.array(dtype=wp.int32)
    start: wp.array(dtype=wp.float64)
    carried: wp.array(dtype=wp.float64)
    stencils: wp.array(dtype=wp.vec4i)
    rows: wp.array(dtype=wp.int32)
    number: wp.array(dtype=wp.int32)
    keys: wp.array(dtype=wp.int32)
    slots: wp.array(dtype=wp.int32)


STARTING, ENDING = wp.constant(1), wp.constant(2)


@wp.struct
class Laws:
    """Contact distance r [m] and stiffness k [Pa/m] of cloth with cloth, and with meshes; the largest b of a mesh [m]."""

    distance: wp.vec2d
    stiffness: wp.vec2d
    width: wp.float64


@wp.struct
class NearFaces:
    """The near faces of each of V vertices at some positions, for a list of C pairs.

    ``code`` (C,) says where the nearest point of a face is, or NONE. ``near`` (C,) has the pairs of the near faces of vertex i
    from rows[i] on. ``counts`` (V,) has their number, and that of contacts with keys from C on. ``multiplicities`` (C,) are m
    of the edges 12, 23 and 31 and of corners 1 to 3, or 0 if another near face counts them.
    """

    code: wp.array(dtype=wp.int32)
    near: wp.array(dtype=wp.int32)
    counts: wp.array(dtype=wp.vec2i)
    multiplicities: wp.array(dtype=SIX)


@wp.struct
class Contacts:
    """The contacts at some positions, by slots: w, n, d, r [m], kA with the sign of m [N/m], ``share``, and ``fixed`` λ [kg·m].

    The contact of pair e of a list with C pairs has the key e. Keys of vertex i from C + 3·rows[i] on are for edges or corners
    of near faces whose nearest points are elsewhere; three a face suffice, because F faces share at most 1.5 F edges and 1.5 F
    vertices. ``code`` is TWO_EDGES for two edges. With 4D = cd these have r/c and c²kA, and the ``ratio`` D/d, else 1.

    ``parts`` are the vertices of the surface; bit i of ``touching`` is 1 if wᵢ is not 0. The stencil has the first vertex of
    the cloth with w = 0 for each obstacle. Obstacles give the ``offset`` o = Σ wⱼXⱼ and the ``travel`` Σ wⱼΔXⱼ by their
    ``moves`` ΔX in the step (B·m,) [m].

    The ``share`` is the curvature Σ kA φ″ along n of contacts on its side of the vertex, over that of positive ones. The
    definite part of the Hessian, and what sweeps compute anew, have this share; sweeps leave the rest ``fixed``.
    """

    weights: wp.array(dtype=wp.vec4d)
    normal: wp.array(dtype=wp.vec3d)
    gap: wp.array(dtype=wp.float64)
    distance: wp.array(dtype=wp.float64)
    stiffness: wp.array(dtype=wp.float64)
    share: wp.array(dtype=wp.float64)
    ratio: wp.array(dtype=wp.float64)
    fixed: wp.array(dtype=wp.float64)
    code: wp.array(dtype=wp.int32)
    parts: wp.array(dtype=wp.vec4i)
    touching: wp.array(dtype=wp.int32)
    offset: wp.array(dtype=wp.vec3d)
    travel: wp.array(dtype=wp.vec3d)
    moves: wp.array(dtype=wp.vec3d)
    followed: Followed


@wp.struct
class Areas:
    """Rest areas of vertices of the surface, and of each edge at them (V,) [m²]; rest positions in a copy (n + m,) [m]."""

    of_vertices: wp.array(dtype=wp.float64)
    of_edges: wp.array(dtype=wp.float64)
    rest: wp.array(dtype=wp.vec3d)


@wp.func
def corner_of(s: wp.vec4i, u: int):
    found = wp.int32(0)
    for i in range(1, 4):
        if s[i] == u:
            found = i
    return found


@wp.func
def code_between(i: int, j: int):
    """The code of the edge between the corners i and j, 1 to 3, or of the corner i = j."""
    return wp.where(i == j, CORNER + i - 1, wp.where(i + j == 3, EDGE, EDGE + 6 - i - j))


STENCILS, NUMBERS = wp.array(dtype=wp.vec4i), wp.array(dtype=wp.int32)
_stencil, _number = load(wp.vec4i), load(wp.int32)


@wp.func  # on the CPU a function that takes a struct copies it
def count_faces(stencils: STENCILS, codes: NUMBERS, near: NUMBERS, first: int, end: int, p: int, q: int):
    """Counts the near faces of a vertex at an edge pq, or a vertex p = q. Their pairs are ``near`` from ``first`` to ``end``.

    Returns the owner, which is the first face with its nearest point there or else the first; the number of faces; of those
    with their nearest point there; and the first face.
    """
    lowest = wp.int32(-1)
    owner = wp.int32(-1)
    faces = wp.int32(0)
    on = wp.int32(0)
    for k in range(first, end):
        f = _number(near, k)
        s = _stencil(stencils, f)
        i = corner_of(s, p)
        j = corner_of(s, q)
        if i > 0 and j > 0:
            here = _number(codes, f) == code_between(i, j)
            if faces == 0:
                lowest = f
            if faces == 0 or (here and on == 0):
                owner = f
            faces += 1
            on += wp.where(here, 1, 0)
    return owner, faces, on, lowest


@wp.func
def put_contact(
    key: int,
    code: int,
    s: wp.vec4i,
    w: wp.vec4d,
    y: wp.vec3d,
    r: wp.float64,
    kA: wp.float64,
    x: wp.array(dtype=Any),
    pairs: Pairs,
    contacts: Contacts,
):
    """Takes a new slot for a contact and stores it there; returns the slot, or −1 if none is free."""
    gap = wp.length(y)
    own = cloth_vertex(pairs.layout, s)
    of_cloth = wp.vec4i(s[0], s[1], s[2], s[3])
    for i in range(4):
        if s[i] >= pairs.layout.cloth:
            of_cloth[i] = own
    slot = take_slot(pairs, key, of_cloth)
    if slot < 0:
        return slot
    contacts.parts[slot] = s
    contacts.code[slot] = code
    touching = wp.int32(0)
    for i in range(4):
        if w[i] != ZERO:
            touching += 1 << i
    contacts.touching[slot] = touching
    if pairs.layout.obstacles > 0:
        o = wp.vec3d()
        travel = wp.vec3d()
        for i in range(4):
            j = s[i] - pairs.layout.cloth
            if j >= 0:
                o += w[i] * wp.vec3d(x[s[i]])
                travel += w[i] * contacts.moves[j]
                w[i] = ZERO
        contacts.offset[slot] = o
        contacts.travel[slot] = travel
    contacts.weights[slot] = w
    contacts.normal[slot] = y / wp.max(gap, wp.float64(1e-300))
    contacts.gap[slot] = gap
    contacts.distance[slot] = r
    contacts.stiffness[slot] = kA
    contacts.share[slot] = ONE
    contacts.ratio[slot] = ONE
    contacts.fixed[slot] = ZERO
    return slot


@wp.func
def slot_of(pairs: Pairs, near: NUMBERS, first: int, count: int, extra: int, i: int):
    key = extra + i - count
    if i < count:
        key = near[first + i]
    return slot_with(pairs.slots, pairs.keys, pairs.number, key)


@wp.func
def set_shares(
    pairs: Pairs, contacts: Contacts, near: NUMBERS, first: int, count: int, extra: int, extras: int, lane: int, lanes: int
):
    for i in range(lane, count + extras, lanes):
        one = slot_of(pairs, near, first, count, extra, i)
        if one >= 0 and contacts.stiffness[one] > ZERO:
            total = ZERO
            positive = ZERO
            for j in range(count + extras):
                other = slot_of(pairs, near, first, count, extra, j)
                if other < 0:
                    continue
                r = contacts.distance[other]
                gap = contacts.gap[other]
                # Contacts beyond r have no force, so that others have the same share with a goal as without.
                beyond = gap >= r and contacts.gap[one] < contacts.distance[one]
                turn = wp.dot(contacts.normal[one], contacts.normal[other])
                if not beyond and turn > ZERO:
                    curvature = contacts.stiffness[other] * bend(wp.min(gap, r), r) * turn * turn
                    total += curvature
                    positive += wp.max(curvature, ZERO)
            contacts.share[one] = wp.clamp(total / positive, ZERO, ONE)


@cache
def lowest_gap(dtype):
    """Device function (of_vertex, stencil, n, b, c, d, goal, move) → a lower bound of the gap, with b, c and d from vertex 0.

    It is the gap along n there or, if less, at goal + move, where the pair may have passed through.
    """
    vec3, _ = types(dtype)
    at, points = vertex_of(dtype), wp.array(dtype=vec3)

    @wp.func
    def find(of_vertex: bool, s: wp.vec4i, n: wp.vec3d, b: wp.vec3d, c: wp.vec3d, d: wp.vec3d, goal: points, move: points):
        found = gap_along(of_vertex, n, b, c, d)
        if goal:
            p = at(goal, move, s[0])
            q = at(goal, move, s[1]) - p
            t = at(goal, move, s[2]) - p
            u = at(goal, move, s[3]) - p
            found = wp.min(found, gap_along(of_vertex, n, q, t, u))
        return found

    return find


@cache
def find_near_faces(dtype):
    """Kernel over listed pairs of a vertex and a face: where the nearest point is, at x or x + correction.

    A face is near if it has a force, or may have one at goal + move. Only the first ``vertices`` count.
    """
    vec3, _ = types(dtype)
    at, lowest = vertex_of(dtype), lowest_gap(dtype)

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def find_each_near_face(
        # elements
        lists: Pairs,
        # state in
        normals: wp.array(dtype=wp.vec3d),
        x: wp.array(dtype=vec3),
        correction: wp.array(dtype=vec3),
        goal: wp.array(dtype=vec3),
        move: wp.array(dtype=vec3),
        # parameters
        laws: Laws,
        vertices: int,
        # out
        faces: NearFaces,
    ):
        for e in range(wp.tid(), wp.min(lists.counts[0], lists.stencils.shape[0]), lists.threads):
            s = _stencil(lists.stencils, e)
            v = s[0]
            found = NONE
            r = laws.distance[wp.where(has_obstacle(lists.layout, s), 1, 0)]
            if v < vertices and lists.distances[e] == wp.float64(dtype(r)):  # else the rest distance is below 2r
                r = wp.where(v < lists.layout.cloth, r, CLOSE * r)
                a = at(x, correction, v)
                b = at(x, correction, s[1]) - a
                c = at(x, correction, s[2]) - a
                d = at(x, correction, s[3]) - a
                if lowest(True, s, normals[e], b, c, d, goal, move) < r:
                    code, w = nearest_of_face(b, c, d)
                    y = w[0] * b + w[1] * c + w[2] * d
                    if goal or wp.length(y) < r:
                        found = code
            faces.code[e] = found

    return find_each_near_face


@wp.kernel(module="warpcloth.self_contact", enable_backward=False)
def list_near_faces(
    # elements
    lists: Pairs,
    # parameters
    vertices: int,
    threads: int,
    # out
    faces: NearFaces,
):
    """Kernel over vertices: lists their ``near`` faces; none if keys of their contacts would exceed 2C."""
    for v in range(wp.tid(), vertices, threads):
        first = lists.rows[v]
        end = lists.rows[v + 1]
        near = wp.int32(0)
        if 3 * end <= lists.stencils.shape[0]:
            for e in range(first, end):
                if _number(faces.code, e) != NONE:
                    faces.near[first + near] = e
                    near += 1
        faces.counts[v] = wp.vec2i(near, 0)


@cache
def count_multiplicities(dtype):
    """Kernel over listed pairs of a vertex and a face: the multiplicities of the terms that a near face owns."""
    vec3, _ = types(dtype)
    at = vertex_of(dtype)
    points = wp.array(dtype=vec3)

    @wp.func
    def edges_at(
        stencils: STENCILS, codes: NUMBERS, near: NUMBERS, first: int, end: int, p: int, a: wp.vec3d, x: points, d: points
    ):
        """The number of edges of near faces at p; those with p nearest to a count once for each of their faces."""
        edges = wp.int32(0)
        P = at(x, d, p) - a
        for k in range(first, end):
            f = _number(near, k)
            s = _stencil(stencils, f)
            i = corner_of(s, p)
            for j in range(1, 4):
                if i > 0 and j != i:
                    _owner, count, _on, lowest = count_faces(stencils, codes, near, first, end, p, s[j])
                    if lowest == f:
                        edges += wp.where(along(P, at(x, d, s[j]) - a) <= ZERO, count, 1)
        return edges

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def count_each_multiplicity(
        # elements
        lists: Pairs,
        # state in
        x: wp.array(dtype=vec3),
        correction: wp.array(dtype=vec3),
        # parameters
        vertices: int,
        # out
        near_faces: NearFaces,
    ):
        for e in range(wp.tid(), wp.min(lists.counts[0], lists.stencils.shape[0]), lists.threads):
            s = _stencil(lists.stencils, e)
            if s[0] >= vertices or _number(near_faces.code, e) == NONE:
                continue
            first = lists.rows[s[0]]
            near = near_faces.counts[s[0]][0]
            if near < 2:
                continue
            end = first + near
            a = at(x, correction, s[0])
            found = SIX()
            for i in range(1, 4):
                j = wp.where(i == 3, 1, i + 1)
                owner, faces, m, _lowest = count_faces(lists.stencils, near_faces.code, near_faces.near, first, end, s[i], s[j])
                if owner == e:
                    P = at(x, correction, s[i]) - a
                    Q = at(x, correction, s[j]) - a
                    if along(P, Q) > ZERO and along(Q, P) > ZERO:
                        m -= faces - 1
                    found[i - 1] = m
                owner, faces, m, _lowest = count_faces(lists.stencils, near_faces.code, near_faces.near, first, end, s[i], s[i])
                if owner == e:
                    m += 1 + faces
                    m -= edges_at(lists.stencils, near_faces.code, near_faces.near, first, end, s[i], a, x, correction)
                    found[i + 2] = m
            near_faces.multiplicities[e] = found

    return count_each_multiplicity


@cache
def find_vertex_contacts(dtype):
    """Kernel over vertices: their contacts at x or x + correction. ``distant`` contacts may have no force."""
    vec3, _ = types(dtype)
    at = vertex_of(dtype)

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def find_contacts_of_vertex(
        # elements
        lists: Pairs,
        areas: Areas,
        # state in
        x: wp.array(dtype=vec3),
        correction: wp.array(dtype=vec3),
        # parameters
        laws: Laws,
        distant: bool,
        vertices: int,
        threads: int,
        # in and out
        faces: NearFaces,
        # out
        pairs: Pairs,
        contacts: Contacts,
    ):
        for v in range(wp.tid(), vertices, threads):
            near = faces.counts[v][0]
            if near == 0:
                continue
            first = lists.rows[v]
            extra = lists.stencils.shape[0] + 3 * first
            a = at(x, correction, v)
            extras = wp.int32(0)
            for k in range(first, first + near):
                e = _number(faces.near, k)
                code = _number(faces.code, e)
                s = _stencil(lists.stencils, e)
                r = laws.distance[0]
                kA = SIDE * laws.stiffness[0] * areas.of_vertices[v]
                if has_obstacle(lists.layout, s):
                    r = laws.distance[1]
                    kA = laws.stiffness[1] * areas.of_vertices[v]
                    if v >= lists.layout.cloth:
                        r *= CLOSE
                        kA /= CLOSE * CLOSE
                b = at(x, correction, s[1]) - a
                c = at(x, correction, s[2]) - a
                d = at(x, correction, s[3]) - a
                corners = wp.matrix_from_rows(b, c, d)
                if code == INSIDE or near == 1:
                    w4, y = vertex_triangle(b, c, d)
                    put_contact(e, code, s, w4, y, r, kA, x, pairs, contacts)
                if near == 1:
                    continue
                multiplicities = faces.multiplicities[e]
                for i in range(1, 4):
                    j = wp.where(i == 3, 1, i + 1)
                    P = corners[i - 1]
                    Q = corners[j - 1]
                    m = multiplicities[i - 1]
                    if m != 0:
                        t = along(P, Q) / (along(P, Q) + along(Q, P))
                        y = (t - ONE) * P - t * Q
                        if distant or wp.length(y) < r:
                            w4 = wp.vec4d(ONE, ZERO, ZERO, ZERO)
                            w4[i] = t - ONE
                            w4[j] = -t
                            key = wp.where(code == code_between(i, j), e, extra + extras)
                            extras += wp.where(key == e, 0, 1)
                            put_contact(key, code, s, w4, y, r, wp.float64(m) * kA, x, pairs, contacts)
                    m = multiplicities[i + 2]
                    if m != 0 and (distant or wp.length(P) < r):
                        w4 = wp.vec4d(ONE, ZERO, ZERO, ZERO)
                        w4[i] = -ONE
                        key = wp.where(code == code_between(i, i), e, extra + extras)
                        extras += wp.where(key == e, 0, 1)
                        put_contact(key, code, s, w4, -P, r, wp.float64(m) * kA, x, pairs, contacts)
            faces.counts[v] = wp.vec2i(near, extras)

    return find_contacts_of_vertex


@wp.kernel(module="warpcloth.self_contact", enable_backward=False)
def share_contacts(
    # elements
    lists: Pairs,
    # state in
    faces: NearFaces,
    pairs: Pairs,
    # parameters
    vertices: int,
    lanes: int,
    threads: int,
    # out
    contacts: Contacts,
):
    """Kernel over vertices, each of ``lanes`` threads: the shares of their contacts."""
    for thread in range(wp.tid(), vertices * lanes, threads):
        v = thread // lanes
        counts = faces.counts[v]
        if counts[1] > 0:
            first = lists.rows[v]
            extra = lists.stencils.shape[0] + 3 * first
            set_shares(pairs, contacts, faces.near, first, counts[0], extra, counts[1], thread - v * lanes, lanes)


@wp.func
def width_of(areas: Areas, layout: Layout, laws: Laws, i: int, j: int):
    """The rest area of an edge over its length [m]; of a mesh, at most the largest of the cloth."""
    length = wp.length(areas.rest[in_copy(layout, j)] - areas.rest[in_copy(layout, i)])
    found = (areas.of_edges[i] + areas.of_edges[j]) / length
    if i >= layout.cloth:
        found = wp.min(found, laws.width)
    return found


@cache
def find_edge_contacts(dtype):
    """Kernel over listed pairs of edges: their contacts at x or x + correction, or which may have a force at goal + move."""
    vec3, _ = types(dtype)
    at, lowest = vertex_of(dtype), lowest_gap(dtype)

    @wp.kernel(module=module_of(dtype), enable_backward=False)
    def find_contact_of_edges(
        # elements
        lists: Pairs,
        areas: Areas,
        # state in
        normals: wp.array(dtype=wp.vec3d),
        x: wp.array(dtype=vec3),
        correction: wp.array(dtype=vec3),
        goal: wp.array(dtype=vec3),
        move: wp.array(dtype=vec3),
        # parameters
        laws: Laws,
        # out
        pairs: Pairs,
        contacts: Contacts,
    ):
        end = wp.min(lists.counts[0] + lists.counts[1], lists.stencils.shape[0])
        for e in range(lists.counts[0] + wp.tid(), end, lists.threads):
            s = _stencil(lists.stencils, e)
            law = wp.where(has_obstacle(lists.layout, s), 1, 0)
            if lists.distances[e] != wp.float64(dtype(laws.distance[law])):
                continue
            r = CLOSE * laws.distance[law]
            a = at(x, correction, s[0])
            b = at(x, correction, s[1]) - a
            c = at(x, correction, s[2]) - a
            d = at(x, correction, s[3]) - a
            if lowest(False, s, normals[e], b, c, d, goal, move) >= r:
                continue
            p, ratio = on_two_edges(b, c, d)
            y = p[0] * b - (c + p[1] * (d - c))
            if not goal and ratio * wp.length(y) >= r:
                continue
            factor = ratio / CLOSE
            A = HALF_PI * width_of(areas, lists.layout, laws, s[0], s[1]) * width_of(areas, lists.layout, laws, s[2], s[3])
            w = wp.vec4d(ONE - p[0], p[0], p[1] - ONE, -p[1])
            kA = factor * factor * laws.stiffness[law] * A
            slot = put_contact(e, TWO_EDGES, s, w, y, laws.distance[law] / factor, kA, x, pairs, contacts)
            if slot >= 0:
                contacts.ratio[slot] = ratio

    return find_contact_of_edges
