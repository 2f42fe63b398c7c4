"""One setup of each solver and sweep, and the cloth that it steps."""

import io
import re

import warp as wp

import warpcloth as wc

SOLVERS = {
    "explicit": wc.Explicit(substeps=1),
    "newton": wc.Newton(substeps=1, tolerance=1e-12),
    "newton factorised": wc.Newton(substeps=1, tolerance=1e-12, linear="factorised"),
    "newton midpoint": wc.Newton(substeps=1, tolerance=1e-12, integrator="midpoint"),
    "newton bdf2": wc.Newton(substeps=1, tolerance=1e-12, integrator="bdf2"),
    "pbd": wc.PBD(substeps=1, iterations=4),
    "pbd sequential": wc.PBD(substeps=1, iterations=4, sweep="sequential", correction="per-step"),
    "pbd averaged by vertex": wc.PBD(substeps=1, iterations=4, sweep="vertex-averaged"),
    "pbd averaged by constraint": wc.PBD(substeps=1, iterations=4, sweep="constraint-averaged"),
    "pbd plain": wc.PBD(substeps=1, iterations=4, sweep="jacobi", relaxation=0.3),
    "hierarchical pbd": wc.HierarchicalPBD(substeps=1, iterations=4),
    "xpbd": wc.XPBD(substeps=1, iterations=4),
    "xpbd sequential": wc.XPBD(substeps=1, iterations=4, sweep="sequential", form="scalar"),
    "xpbd averaged by constraint": wc.XPBD(substeps=1, iterations=4, sweep="constraint-averaged"),
    "projective dynamics": wc.ProjectiveDynamics(substeps=1, iterations=8),
    "projective dynamics plain": wc.ProjectiveDynamics(substeps=1, iterations=4, acceleration="none"),
    "projective dynamics chebyshev": wc.ProjectiveDynamics(substeps=1, iterations=16, acceleration="chebyshev"),
    "projective dynamics l-bfgs": wc.ProjectiveDynamics(substeps=1, iterations=8, acceleration="l-bfgs"),
    "projective dynamics matrix-free": wc.ProjectiveDynamics(substeps=1, iterations=8, linear="jacobi"),
    "constrained dynamics": wc.ConstrainedDynamics(substeps=1, iterations=4),
    "constrained dynamics factorised": wc.ConstrainedDynamics(substeps=1, iterations=4, linear="factorised"),
    "constrained dynamics searching": wc.ConstrainedDynamics(substeps=1, iterations=4, stabilisation="line-search"),
    "constrained dynamics once": wc.ConstrainedDynamics(substeps=1, iterations=1, stabilisation="none"),
    "admm": wc.ADMM(substeps=1, iterations=4),
}
# One of each solver, for what does not depend on how it sweeps, accelerates or solves its systems.
MAIN = (
    "explicit",
    "newton",
    "pbd",
    "hierarchical pbd",
    "xpbd",
    "projective dynamics",
    "constrained dynamics",
    "admm",
)
# What runs of each is tested in float32, which rounds more and is the default on CUDA; in float64 the kernels are the same.
RUNS = [(name, "float32") for name in SOLVERS] + [(name, "float64") for name in MAIN]


def square(n=6, solver=None, damping=None, **scene):
    """A small cloth with springs and both kinds of bending, or what of them ``solver`` takes, 0.1 kg/m².

    Explicit steps have the kernels of all terms in one, which hinges make three times as long to compile; test_backends.py has
    them.
    """
    mesh = wc.Mesh.grid(n, n, pattern="alternating")
    terms = [
        wc.Spring(pairs=("structural", "shear"), stiffness=100.0, damping=damping),
        wc.QuadraticBending(stiffness=1e-4),
        wc.DihedralBending(stiffness=1e-4),
    ]
    if isinstance(solver, (wc.Explicit, wc.ProjectiveDynamics)):  # the angle of a hinge is no distance
        terms.pop()
    return wc.Scene(mesh, density=0.1, terms=terms, **scene)


def allocations(tracker, work):
    """Number of Warp allocations while ``work`` runs."""
    tracker.clear()
    keep = work()
    report = io.StringIO()
    tracker.report(file=report)
    del keep
    found = re.search(r"Total allocations:\s+\S+\s+(\d+)", report.getvalue())
    return int(found[1]) if found else 0


def allocated(work, device):
    """The same, with a check that the tracker sees an allocation."""
    with wp.ScopedMemoryTracker("work", print=False) as tracker:
        assert allocations(tracker, lambda: wp.zeros(3, device=device)) == 1
        return allocations(tracker, work)
