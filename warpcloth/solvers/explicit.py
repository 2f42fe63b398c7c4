"""Explicit integration: symplectic and forward Euler, and the largest step that the first may take."""

import warnings
from dataclasses import dataclass

import numpy as np

from ..capture import Segment
from ..checks import choice
from ..kernels import step as kernels
from ..operators import Gradient, Hessian
from .solver import Step, Stepper, refuse_hard

_INSTEAD = "PBD and XPBD take hard constraints, or give a finite stiffness"


@dataclass(frozen=True)
class Explicit(Step):
    """Explicit Euler. Symplectic (kick, then drift): v += h a(x), x += h v; forward: x += h v, v += h a with the old both.

    On x″ = −ω²x the symplectic scheme keeps v² + ω²x² − hω²xv and is stable for h < 2/ω; forward Euler multiplies the energy
    by 1 + h²ω² a step, whatever h is (Provot 1995; Hairer, Lubich and Wanner 2006, *Geometric numerical integration*).

    Attributes:
        dt, substeps: See :class:`Step`.
        scheme: ``"symplectic"`` or ``"forward"``.
        above_limit: ``"refuse"`` or ``"allow"`` a step that is unstable about the rest shape.

    Raises:
        ValueError: If an option breaks a rule.
    """

    scheme: str = "symplectic"
    above_limit: str = "refuse"

    def __post_init__(self):
        super().__post_init__()
        choice("scheme", self.scheme, ("symplectic", "forward"))
        choice("above_limit", self.above_limit, ("refuse", "allow"))

    def bind(self, model):
        """The solver on ``model``, all scratch allocated.

        Warns:
            UserWarning: If the step is above the bound in motion, see :func:`step_limits`, which counts hinges and
                membranes as at rest.

        Raises:
            ValueError: If the step is above the limit and that is not allowed, or a stiffness is infinite.
        """
        refuse_hard(model, "Explicit", _INSTEAD)
        stepper = ExplicitStepper(self, model)
        if self.above_limit == "refuse":
            self._refuse_unstable(model, stepper.h)
        return stepper

    def _refuse_unstable(self, model, h):
        rest, motion = step_limits(model)
        fewest = int(1.0 / (model.scene.fps * rest)) + 1 if rest > 0.0 else 0
        allow = 'above_limit="allow" runs it all the same'
        if self.scheme == "forward":
            raise ValueError(
                f"dt is {h:.6g} s; forward Euler is stable at no step (symplectic Euler up to {rest:.6g} s); {allow}"
            )
        if h >= rest:
            raise ValueError(
                f"dt is {h:.6g} s; about the rest shape symplectic Euler is stable below {rest:.6g} s, that is from "
                f"{fewest} substeps a frame; {allow}"
            )
        if h >= motion:
            warnings.warn(
                f"dt is {h:.6g} s; below {rest:.6g} s it is stable about the rest shape, but only below {motion:.6g} s "
                "in motion, hinges and membranes counted as at rest",
                stacklevel=3,
            )


def step_limits(model):
    """The largest stable steps of symplectic Euler [s]: about the rest shape, and in motion, see below.

    The first is 2/ω with ω² the largest eigenvalue of M⁻¹∂²U/∂x² at rest, by Lanczos iteration; the second 2/√G with
    Gershgorin's G = max over vertices of Σ‖∂²uₑ/∂xᵢ∂xⱼ‖/m, summed over elements and their vertices. For springs that is
    2·Σk/m, which no motion exceeds, and neither does one of quadratic bending. The Hessian of dihedral bending grows as the
    cloth folds or is compressed and those of membranes as they stretch, so for scenes with these the second is no bound there:
    it counts them as at rest. Limits, which at rest have no stiffness, are counted as reached, in both.

    Returns:
        (rest, motion); infinite where nothing is stiff.

    Raises:
        ValueError: If a stiffness is infinite.
    """
    from scipy.sparse import diags
    from scipy.sparse.linalg import eigsh

    refuse_hard(model, "Explicit", _INSTEAD)
    hessian = Hessian(model, terms=[elements.taut(model.scene.mesh.points) for elements in model.terms])
    rest_shape = np.tile(model.scene.mesh.points, (model.copies, 1))
    hessian.assemble(model.array(rest_shape, model.vec3), 0.0)
    inverse_mass = model.inverse_mass.numpy().astype(np.float64)
    root = diags(np.repeat(np.sqrt(inverse_mass), 3))
    matrix = (root @ hessian.matrix() @ root).tocsr()
    rows = np.zeros(model.count)
    for elements, blocks in zip(hessian.terms, hessian.blocks, strict=True):
        K = elements.term.vertices
        sizes = np.abs(blocks.numpy().astype(np.float64))
        # √(‖·‖₁‖·‖∞) is no less than the spectral norm, equal to it along the axes and diagonals of a grid, and cheap.
        norms = np.sqrt(sizes.sum(axis=-1).max(axis=-1) * sizes.sum(axis=-2).max(axis=-1)).reshape(-1, K, K).sum(axis=2)
        np.add.at(rows, elements.stencil.numpy(), norms)
    bound = float((rows * inverse_mass).max(initial=0.0))
    if bound == 0.0:
        return np.inf, np.inf
    start = np.random.default_rng(0).normal(size=matrix.shape[0])
    if matrix.shape[0] > 30:
        # The upper eigenvalues of a large net lie close together: 1e-4 takes 35 s at 512² vertices, 1e-2 a second, and the
        # limit that it gives is 0.2 % too large.
        tolerance = 1e-4 if matrix.shape[0] < 50_000 else 1e-2
        largest = float(eigsh(matrix, k=1, which="LA", v0=start, return_eigenvectors=False, tol=tolerance)[0])
    else:
        largest = float(np.linalg.eigvalsh(matrix.toarray())[-1])
    return (2.0 / np.sqrt(largest) if largest > 0.0 else np.inf), 2.0 / np.sqrt(bound)


class ExplicitStepper(Stepper):
    """:class:`Explicit` on a model."""

    def __init__(self, options, model):
        super().__init__(options, model)
        self.gradient = model.vectors()
        self._gradient_of = Gradient(model)
        self._update = model.kernel(kernels.explicit_update, model.dtype, options.scheme == "symplectic")
        self._step = Segment(model.device, self._launch_step)

    def _launch_step(self):
        model, (x, v) = self.model, self.state
        self._gradient_of.add(x, self.gradient)
        given = [model.inverse_mass, model.gravity, model.per_copy, self.h]
        model.launch(self._update, model.count, given, [self.gradient, x, v])
        self.launch_pins()

    def step(self):
        self._step()
