"""The pattern of the Hessian: columns ascend in each row, and so do the element blocks that are added; alike in all copies."""

import numpy as np

import warpcloth as wc
from warpcloth.core.hessian import Hessian


def test_the_pattern_is_that_of_all_elements_in_order(device):
    """Of two copies, counted element by element; a pinned vertex has its diagonal block alone."""
    mesh = wc.Mesh.grid(4, 4, pattern="alternating")
    terms = [wc.Spring(pairs="edges", stiffness=10.0), wc.QuadraticBending(stiffness=1e-4)]
    model = wc.Scene(mesh, density=0.2, terms=terms, pins=[0, 6]).build(device=device, copies=2)
    hessian = Hessian(model)
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
    assert hessian.offsets.numpy().tolist() == np.searchsorted(rows, np.arange(model.count + 1)).tolist()
    assert hessian.columns.numpy().tolist() == [j for _, j in ordered]
    assert hessian.diagonal.numpy().tolist() == [ordered.index((i, i)) for i in range(model.count)]
    for t, (offsets, sources) in enumerate(hessian.gathers):
        parts = np.split(sources.numpy(), offsets.numpy()[1:-1])
        assert [part.tolist() for part in parts] == [pairs[pair][t] for pair in ordered]
