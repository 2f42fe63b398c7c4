"""The report of what a model consists of."""

import numpy as np
import warp as wp


def report(model):
    """Describes a model: a dict of scene, vertices, copies, dtype, device, bytes, terms (elements and bytes) and kernels.

    Terms of one label are numbered from the second on: Spring, Spring 2. Kernels are factory(variant).Term.
    """
    labels = [elements.label for elements in model.terms]
    before = [labels[:i].count(label) for i, label in enumerate(labels)]
    arrays = [model.positions, model.velocities, model.mass, model.inverse_mass, model.gravity]
    arrays += [array for array in (model.pins, model.keyframes, model.pin_axes, model.mobility) if array is not None]
    arrays += [] if model.colliders is None else model.colliders.arrays
    arrays += [model.free_gravity[0]] * (model.mobility is not None)
    arrays += [] if model.loads is None else model.loads.arrays
    terms = [
        {
            "term": elements.label + (f" {count + 1}" if count else ""),
            "elements": elements.count,
            "bytes": sum(_bytes(array) for array in elements.arrays),
        }
        for elements, count in zip(model.terms, before, strict=True)
    ]
    return {
        "scene": model.scene.name,
        "vertices": model.count,
        "copies": model.copies,
        "dtype": np.dtype(model.numpy_dtype).name,
        "device": str(model.device),
        "bytes": sum(_bytes(array) for array in arrays) + sum(term["bytes"] for term in terms),
        "terms": terms,
        "kernels": sorted(model.kernels),
    }


def _bytes(array):
    return wp.types.type_size_in_bytes(array.dtype) if 0 in array.strides else array.size * array.strides[-1]
