"""The energies of the catalogue on meshes and by themselves, and closed forms of them."""

import numpy as np
import pytest

import warpcloth as wc
from support.outside import Plane
from support.rows import slow_but
from warpcloth.core.energy import Energy
from warpcloth.core.gradient import Gradient
from warpcloth.core.sums import Sums
from warpcloth.model.damping import dissipations
from warpcloth.model.precision import DTYPES
from warpcloth.terms.refresh import STEP, Moment

# A few roundings in a row: no sum here has more than a dozen addends that matter.
FEW = 16


def eps(dtype):
    return float(np.finfo(dtype).eps)


every_dtype = pytest.mark.parametrize("dtype", slow_but(["float64"], DTYPES))
# What a material of the tests has beside its stiffness, for the rest state.
MATERIALS = {
    "StVKMembrane": {"poisson_ratio": 0.3},
    "NeoHookeanMembrane": {"poisson_ratio": 0.3},
    "OrthotropicMembrane": {"warp": np.array([2.0, 0.5, 1.0]), "weft_ratio": 2.0, "poisson_ratio": 0.3, "shear_ratio": 0.2},
    "SpringLimit": {"least": 0.9, "most": 1.05},
    "StrainLimit": {"least": 0.9, "most": 1.05},
    "Plane": {"normal": np.array([1.0, 2.0, 2.0])},
}


def random_rotation(random):
    q, r = np.linalg.qr(random.normal(size=(3, 3)))
    q *= np.sign(np.diag(r))
    return q * np.linalg.det(q)


# u(σ₁, σ₂) per area as it is in textbooks, of μ and λ.
DENSITIES = {
    "CorotatedMembrane": lambda a, b, mu, lam: mu * ((a - 1.0) ** 2 + (b - 1.0) ** 2),
    "StVKMembrane": lambda a, b, mu, lam: (
        0.25 * mu * ((a * a - 1.0) ** 2 + (b * b - 1.0) ** 2) + 0.125 * lam * (a * a + b * b - 2.0) ** 2
    ),
    "NeoHookeanMembrane": lambda a, b, mu, lam: (
        0.5 * mu * (a * a + b * b - 2.0) - mu * (a * b - 1.0) + 0.5 * (lam + mu) * (a * b - 1.0) ** 2
    ),
}


def material_of(name, ratio):
    """Arguments of the rest state, and μ, λ, of a membrane with Et = 1."""
    given = {} if name == "CorotatedMembrane" else {"poisson_ratio": ratio}
    ratio = given.get("poisson_ratio", 0.0)
    return given, 0.5 / (1.0 + ratio), ratio / (1.0 - ratio**2)


HALF = 0.5 * np.sqrt(3.0)
EQUILATERAL = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.5, HALF, 0.0], [0.5, -HALF, 0.0]])
DECLARED = {
    "Spring": lambda mesh: wc.Spring(stiffness=50.0),
    "CorotatedMembrane": lambda mesh: wc.CorotatedMembrane(stiffness=50.0),
    "StVKMembrane": lambda mesh: wc.StVKMembrane(stiffness=50.0, **MATERIALS["StVKMembrane"]),
    "NeoHookeanMembrane": lambda mesh: wc.NeoHookeanMembrane(stiffness=50.0, **MATERIALS["NeoHookeanMembrane"]),
    "OrthotropicMembrane": lambda mesh: wc.OrthotropicMembrane(stiffness=50.0, **MATERIALS["OrthotropicMembrane"]),
    "SpringLimit": lambda mesh: wc.SpringLimit(stiffness=50.0, **MATERIALS["SpringLimit"]),
    "StrainLimit": lambda mesh: wc.StrainLimit(stiffness=50.0, **MATERIALS["StrainLimit"]),
    "QuadraticBending": lambda mesh: wc.QuadraticBending(stiffness=0.5),
    "PlateBending": lambda mesh: wc.PlateBending(stiffness=0.5, poisson_ratio=0.3, weft_ratio=2.0, warp=(1.0, 0.0, 1.0)),
    "ShellBending": lambda mesh: wc.ShellBending(stiffness=0.5, poisson_ratio=0.3),
    "DihedralBending": lambda mesh: wc.DihedralBending(stiffness=0.5),
    "Plane": lambda mesh: Plane(stiffness=5.0, **MATERIALS["Plane"]),
    "Attachment": lambda mesh: wc.Attachment(vertices=np.arange(len(mesh.points)), stiffness=5.0, targets=1.1 * mesh.points),
}


def model_of(mesh, positions, names=DECLARED, dtype="float64", device="cpu", pins=None, **build):
    terms = [DECLARED[name](mesh) for name in names]
    scene = wc.Scene(mesh, density=0.2, positions=positions, terms=terms, pins=pins)
    return scene.build(device=device, dtype=dtype, **build)


def energy_and_gradient(model, x=None):
    """U (B,) and ∂U/∂x (N, 3) at x (N, 3), where the model starts if None."""
    energy, gradient = model.scalars(), model.vectors()
    x = model.positions if x is None else model.array(x, model.vec3)
    Energy(model, Sums(model)).add(x, energy)
    Gradient(model).add(x, gradient)
    return energy.numpy(), gradient.numpy()


def energies_of_elements(model, x=None):
    """Of each term the energies of its elements at x (N, 3), where the model starts if None."""
    energy = Energy(model, Sums(model))
    energy.add(model.positions if x is None else model.array(x, model.vec3), model.scalars())
    return [each.numpy() for each in energy.of_elements]


CELL = 0.05


def bending_density(name, pattern, shape, device):
    """U/(½D) [1/m²] of the hinges in a window of whole periods of a lattice: no boundary in it."""
    mesh = wc.Mesh.grid(21, 21, size=20 * CELL, pattern=pattern)
    model = model_of(mesh, shape(mesh.points), [name], device=device)
    middle = mesh.points[mesh.hinges[:, :2]].mean(axis=1)
    rows = CELL * np.sqrt(0.75) if pattern == "equilateral" else CELL
    # 10 columns and 10 rows, from a corner that no edge has its middle on.
    column, row = (middle[:, 0] - 5.1 * CELL) / CELL, (middle[:, 2] - 5.1 * rows) / rows
    inside = (column > 0.0) & (column < 10.0) & (row > 0.0) & (row < 10.0)
    assert inside.sum() == 300, "three hinges to each of the 100 cells"
    stiffness = 0.5
    return energies_of_elements(model)[0][inside].sum() / (100 * CELL * rows) / (0.5 * stiffness)


def damping_forces(model, h, x, v):
    """∂D/∂x at x + h v (N, 3), as explicit steps have it, by kernels of one term each."""
    damped, out = dissipations(model, h), model.vectors()
    model.refresh(STEP, Moment(x), damped)
    Gradient(model, corrected=True, terms=damped).add(x, out, model.array(h * v, model.vec3))
    return out.numpy()
