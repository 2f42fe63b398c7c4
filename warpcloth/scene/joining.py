"""Several cloths in one scene."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ..base.checks import shown
from ..mesh.mesh import Mesh
from ..mesh.selection import distinct_vertices

# Fields of the whole scene, which default to the value of the cloths if all have the same.
_COMMON = ("gravity", "duration", "fps")
# Fields of the whole scene that cloths must not set.
_WHOLE = ("colliders", "contact", "self_contact", "air")


def fields_of_cloths(cloths, whole):
    """Returns the fields of a scene of several cloths, without pins; refuses fields that may not be set or that differ."""
    if not (isinstance(cloths, Mapping) and cloths and all(hasattr(cloth, "mesh") for cloth in cloths.values())):
        raise ValueError(f"cloths is {shown(cloths)}; it must be a mapping of names to scenes, with one cloth or more")
    allowed = (*_COMMON, *_WHOLE, "terms", "name", "thickness")
    for name in whole:
        if name not in allowed:
            raise ValueError(f"{name} is given for the whole scene, which takes {', '.join(allowed)}; give it to each cloth")
    for name, cloth in cloths.items():
        for field in _WHOLE:
            if getattr(cloth, field):
                raise ValueError(f"the cloth {name!r} has {field} of its own; give them to the scene of all cloths")
    mesh, each = Mesh.join({name: cloth.mesh for name, cloth in cloths.items()}), list(cloths.values())
    firsts = [part.first for part in (mesh.parts or {}).values()]
    densities, thicknesses = {cloth.density for cloth in each}, {cloth.thickness for cloth in each}
    found = {
        "mesh": mesh,
        "cloths": tuple(cloths),
        "positions": np.concatenate([cloth.positions for cloth in each]),
        "velocities": np.concatenate([cloth.velocities for cloth in each]),
        "terms": [*_terms(cloths), *whole.get("terms", ())],
        "loads": [_moved(load, cloth, first) for cloth, first in zip(each, firsts, strict=True) for load in cloth.loads],
        "thickness": each[0].thickness if len(thicknesses) == 1 else np.nan,
    }
    if len(densities) == 1 and None not in densities:
        found["density"] = each[0].density
    else:
        found["masses"] = np.concatenate([cloth.vertex_masses for cloth in each])
    if any(cloth.free_axes is not None for cloth in each):
        found["free_axes"] = np.concatenate([_free(cloth) for cloth in each])
    return {**found, **_common(cloths, whole), **{key: whole[key] for key in (*_WHOLE, "name", "thickness") if key in whole}}


def pins_of_cloths(cloths):
    """Returns vertices (p,), keyframes (F, p, 3) [m] or None, and axes, on the joined mesh."""
    firsts = np.cumsum([0, *(len(cloth.mesh.points) for cloth in cloths)])
    vertices = np.concatenate([cloth.pins.vertices + first for cloth, first in zip(cloths, firsts[:-1], strict=True)])
    axes = ["".join(axis for axis, holds in zip("xyz", held, strict=True) if holds) for c in cloths for held in c.pins.held]
    frames = max(0 if cloth.pins.keyframes is None else len(cloth.pins.keyframes) for cloth in cloths)
    if not frames:
        return vertices, None, axes
    keyframes = []
    for cloth in cloths:
        own = cloth.positions[cloth.pins.vertices][None] if cloth.pins.keyframes is None else cloth.pins.keyframes
        keyframes.append(np.concatenate([own, np.repeat(own[-1:], frames - len(own), axis=0)]))
    return vertices, np.concatenate(keyframes, axis=1), axes


def _terms(cloths):
    return [replace(term, part=name, name=f"{name}_{term.label}") for name, cloth in cloths.items() for term in cloth.terms]


def _moved(load, cloth, first):
    vertices = distinct_vertices(f"{load.label}.vertices", load.vertices, cloth.mesh)
    return replace(load, vertices=vertices + np.int32(first))


def _free(cloth):
    return np.ones((len(cloth.mesh.points), 3), dtype=bool) if cloth.free_axes is None else cloth.free_axes


def _common(cloths, whole):
    found = {}
    for field in _COMMON:
        if field in whole:
            found[field] = whole[field]
            continue
        first, value = next((name, getattr(cloth, field)) for name, cloth in cloths.items())
        for name, cloth in cloths.items():
            if not np.array_equal(getattr(cloth, field), value):
                own = np.asarray(getattr(cloth, field)).tolist()
                raise ValueError(
                    f"the cloths {first!r} and {name!r} have {field} {np.asarray(value).tolist()} and {own}; "
                    "give the scene of all cloths one"
                )
        found[field] = value
    return found
