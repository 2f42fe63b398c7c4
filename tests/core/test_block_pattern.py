"""The Hessian is the sum of element blocks: those of constant terms are added once.

Its columns ascend in each row, and so do the element blocks that are added; copies are alike.
"""

import numpy as np

import warpcloth as wc
from warpcloth.core.block_pattern import slots_of
from warpcloth.core.constant_matrix import constant_matrices
from warpcloth.core.hessian import Hessian, pattern_of


def test_the_pattern_is_that_of_all_elements_in_order(device):
    """Of two copies, counted element by element; a pinned vertex has its diagonal block alone."""
    mesh = wc.Mesh.grid(4, 4, pattern="alternating")
    terms = [wc.Spring(pairs="edges", stiffness=10.0), wc.QuadraticBending(stiffness=1e-4)]
    model = wc.Scene(mesh, density=0.2, terms=terms, pins=[0, 6]).build(device=device, copies=2)
    found = pattern_of(model, model.terms)
    free = model.inverse_mass.numpy() > 0.0
    pairs = {(i, i): ([], []) for i in range(model.count)}
    for t, elements in enumerate(model.terms):
        for element, stencil in enumerate(elements.stencil.numpy().tolist()):
            for a, i in enumerate(stencil):
                for b, j in enumerate(stencil):
                    if free[i] and free[j]:
                        pairs.setdefault((i, j), ([], []))[t].append((len(stencil) * element + a) * len(stencil) + b)
    ordered = sorted(pairs)
    rows = np.array([i for i, _ in ordered])
    assert found.offsets.numpy().tolist() == np.searchsorted(rows, np.arange(model.count + 1)).tolist()
    assert found.columns.numpy().tolist() == [j for _, j in ordered]
    assert found.diagonal.numpy().tolist() == [ordered.index((i, i)) for i in range(model.count)]
    for t, (offsets, sources) in enumerate(found.sums):
        parts = np.split(sources.numpy(), offsets.numpy()[1:-1])
        assert [part.tolist() for part in parts] == [pairs[pair][t] for pair in ordered]
        slots = slots_of(model, (offsets, sources), model.terms[t].stencil.size * model.terms[t].term.vertices).numpy()
        assert all((slots[part] == s).all() for s, part in enumerate(parts)) and (slots >= 0).sum() == len(sources)


def test_constant_terms_are_added_to_every_assembly(device):
    """The sum is that found by other kernels, to rounding. It does not depend on the assembly before, with locks or without."""
    free = np.ones((16, 3), dtype=bool)
    free[9, 1] = False
    terms = [wc.QuadraticBending(stiffness=0.3), wc.Spring(stiffness=10.0), wc.Attachment(vertices=[5], stiffness=2.0)]
    scene = wc.Scene(wc.Mesh.grid(4, 4), density=0.2, terms=terms, pins=[0], free_axes=free)
    model = scene.build(device=device, dtype="float64")
    x = model.array(np.random.default_rng(0).normal(scale=0.2, size=(16, 3)) + model.positions.numpy(), model.vec3)

    def assembled(hessian, scale):
        hessian.assemble(x, scale)
        return hessian.matrix().toarray()

    whole, moving = Hessian(model), model.coordinate_mobility() > 0.0
    found = [assembled(whole, scale) for scale in (1.0, 5.0, 1.0)]
    assert (found[0] == found[2]).all()
    bending, springs, held = model.terms
    constant = constant_matrices(model.with_terms([bending, held]), 0.0)[0].toarray()
    parts = assembled(Hessian(model, terms=[springs]), 1.0) + np.kron(constant, np.eye(3))
    inside = np.ix_(moving, moving)
    np.testing.assert_allclose(found[0][inside], parts[inside], rtol=0.0, atol=1e-14 * np.abs(parts).max())
    mass = np.repeat(model.mass.numpy(), 3)[moving]
    np.testing.assert_allclose((found[1] - found[0])[inside], np.diag(4.0 * mass), rtol=0.0, atol=1e-14 * np.abs(parts).max())
