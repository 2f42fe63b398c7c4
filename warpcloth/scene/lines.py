"""Lines to draw for strings and bars."""

import numpy as np

# Thickness of springs and of rigid bodies, relative to the mean edge length of the mesh.
_SPRING, _BODY = 0.05, 0.15


def lines_of(scene):
    """Finds the pairs of vertices (E, 2) that a term joins, at least one without a triangle, and their thickness [m], by label.

    Springs give their pairs, rigid bodies the minimum spanning tree of vertices without a triangle, edge meshes none.
    """
    mesh = scene.mesh
    lines: dict[str, tuple[np.ndarray, float]] = {}
    if not len(mesh.triangles) or not len(mesh.isolated):
        return lines
    loose = np.zeros(len(mesh.points), dtype=bool)
    loose[mesh.isolated] = True
    length = mesh.edge_lengths.mean()
    for term in scene.terms:
        found = term.elements(mesh, scene.positions)
        if found.weights is not None:
            continue
        if found.cells is not None:
            bodies = np.split(found.stencil[:, 0], found.cells[1:-1])
            pairs = np.concatenate([_tree(mesh.points, body[loose[body]]) for body in bodies])
        elif found.stencil.shape[1] == 2:
            pairs = found.stencil[loose[found.stencil].any(axis=1)]
        else:
            continue
        if len(pairs):
            before, thickness = lines.get(found.label, (pairs[:0], 0.0))
            own = (_SPRING if found.cells is None else _BODY) * length
            lines[found.label] = np.concatenate([before, pairs]), max(thickness, own)
    return lines


def _tree(points, vertices):
    from scipy.sparse.csgraph import minimum_spanning_tree

    if len(vertices) < 2:
        return np.empty((0, 2), dtype=np.int32)
    apart = np.linalg.norm(points[vertices][:, None] - points[vertices], axis=2)
    return vertices[np.column_stack(minimum_spanning_tree(apart).nonzero())]
