"""Bending of a shell: U = Σ ½A(κ − κ̄n)ᵀC(κ − κ̄n), κ the second derivatives of the positions, κ̄ the curvature at rest [1/m].

κ are three vectors κ₁₁, κ₂₂, κ₁₂ (:mod:`.plate_bending`), less their part along the surface at rest. n = f₁×f₂, of the columns
of the deformation gradient, is the normal, of length 1 at constant area. Without stretch κ = Ln with the curvature L, and U is
that of L − κ̄. Garg et al. 2007, *Cubic shells*, has it for hinges.

The stiffness is D₁ in N·m. The rows of y are κ, multiplied by a square root of C/D₁ as κ̄ is, and bf₁ and bf₂ with b = ‖κ̄‖. The
rest state is A and κ̄/b², or 0 where b is 0. U is a polynomial. Of its Hessian JᵀJ + ∂²(g·n), g = −Σ κ̄(κ − κ̄n), only the
second part can be negative, with the eigenvalues ±‖g‖. At rest JᵀJ is at most 3.
"""

from typing import Any

import warp as wp

from ..term import Term


@wp.func
def measure(rest: Any):
    return rest[0]


@wp.func
def bent(y: Any, rest: Any):
    """κ − κ̄n, (3, 3), row by row."""
    n = wp.cross(y[3], y[4])
    return wp.matrix_from_rows(y[0] - rest[1] * n, y[1] - rest[2] * n, y[2] - rest[3] * n)


@wp.func
def pull(r: Any, rest: Any):
    """g = ∂u/∂n."""
    return -(rest[1] * r[0] + rest[2] * r[1] + rest[3] * r[2])


@wp.func
def energy(y: Any, rest: Any):
    r = bent(y, rest)
    return y.dtype(0.5) * wp.ddot(r, r)


@wp.func
def gradient(y: Any, rest: Any):
    r = bent(y, rest)
    g = pull(r, rest)
    return wp.matrix_from_rows(r[0], r[1], r[2], wp.cross(y[4], g), wp.cross(g, y[3]))


@wp.func
def hessian(y: Any, rest: Any, negative: Any):
    h = wp.identity(n=15, dtype=y.dtype)
    g = pull(bent(y, rest), rest)
    B1 = -wp.skew(y[4])
    B2 = wp.skew(y[3])
    square = rest[1] * rest[1] + rest[2] * rest[2] + rest[3] * rest[3]
    H11 = square * (wp.transpose(B1) * B1)
    H12 = square * (wp.transpose(B1) * B2)
    H22 = square * (wp.transpose(B2) * B2)
    # The second part [[0, −[g]×], [[g]×, 0]] has the absolute value ‖g‖(I − ggᵀ/‖g‖²) in both diagonal blocks.
    turn = -wp.skew(g)
    size = wp.length(g)
    if negative != y.dtype(1.0) and size > y.dtype(0.0):
        half = y.dtype(0.5)
        both = (half - half * negative) * (size * wp.identity(n=3, dtype=y.dtype) - wp.outer(g / size, g))
        turn = (half + half * negative) * turn
        H11 += both
        H22 += both
    H12 += turn
    for row in range(3):
        for column in range(3):
            h[9 + row, 9 + column] = H11[row, column]
            h[12 + row, 12 + column] = H22[row, column]
            h[9 + row, 12 + column] = H12[row, column]
            h[12 + row, 9 + column] = H12[column, row]
            for m in range(3):
                h[3 * m + row, 9 + column] = -rest[1 + m] * B1[row, column]
                h[9 + column, 3 * m + row] = -rest[1 + m] * B1[row, column]
                h[3 * m + row, 12 + column] = -rest[1 + m] * B2[row, column]
                h[12 + column, 3 * m + row] = -rest[1 + m] * B2[row, column]
    return h


SHELL_BENDING = Term(
    name="ShellBending",
    vertices=0,
    rows=5,
    parameters=4,
    rest_state=None,
    weight=None,
    measure=measure,
    energy=energy,
    gradient=gradient,
    hessian=hessian,
    cells=True,
    curvature=3.0,
)
