"""Rotations of 3×3 matrices: worst errors over many matrices of each class, and time and bandwidth beside Warp's svd3.

    python benchmarks/rotation.py accuracy [--count 10000000] [--dtype float32|float64]
    python benchmarks/rotation.py time [--device cpu|cuda:0] [--count 200000]

Both print Markdown tables.
"""

import argparse
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import warp as wp

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from support.matrices import CLASSES, angle, determinant, orthogonality, reconstruction, reference, samples, times
from warpcloth.kernels import decompose, rotation

CHUNK = 1_000_000
ROUNDS = 15
TYPES = {"float32": (wp.float32, wp.mat33f, wp.vec3f), "float64": (wp.float64, wp.mat33d, wp.vec3d)}


@wp.func
def warp_svd3(A: wp.mat33f):
    U, S, V = wp.svd3(A)
    return U, S, V


@wp.func
def warp_svd3(A: wp.mat33d):  # noqa: F811 - Warp chooses by type
    U, S, V = wp.svd3(A)
    return U, S, V


def one(function, matrix, block):
    """Kernel over matrices: R[i] = function(A[i])."""
    load, store = decompose.access(matrix, block)

    @wp.kernel(module="unique", enable_backward=False)
    def rotate(A: wp.array(dtype=matrix), R: wp.array(dtype=matrix)):
        i = wp.tid()
        store(R, i, function(load(A, i)))

    return rotate


def accuracy(count, dtype):
    """Worst of each class, on the CPU: reconstruction, orthogonality, determinant, rotation error times gap; svd3 beside."""
    _, matrix, vector = TYPES[dtype]
    single = one(rotation.nearest_rotation, matrix, 1)
    theirs = decompose.into_three(warp_svd3, matrix, (matrix, vector, matrix), 1)
    heads = (
        "reconstruction | orthogonality | determinant | rotation of the SVD | nearest rotation | NaN | reconstruction by svd3"
    )
    print(f"| class | {heads} |")
    print("|---|---|---|---|---|---|---|---|")
    for name in CLASSES:
        rng = np.random.default_rng(0)
        worst, nans = np.zeros(6), 0
        for start in range(0, count, CHUNK):
            A = samples(name, rng, min(CHUNK, count - start), np.dtype(dtype))
            given = wp.array(A, dtype=matrix, device="cpu")
            U, S, V, R = (wp.empty(len(A), dtype=kind, device="cpu") for kind in (matrix, vector, matrix, matrix))
            decompose.launch(decompose.into_three, rotation.rotation_svd3, given, [U, S, V])
            wp.launch(single, len(A), inputs=[given], outputs=[R], device="cpu")
            U, S, V, R = (array.numpy().copy() for array in (U, S, V, R))
            other = [wp.empty(len(A), dtype=kind, device="cpu") for kind in (matrix, vector, matrix)]
            wp.launch(theirs, len(A), inputs=[given], outputs=other, device="cpu")
            X, x, Y = (array.numpy() for array in other)
            Q, signed = reference(A)
            gap = np.maximum(signed[:, 1] + signed[:, 2], 0.0) / np.where(signed[:, 0] > 0, signed[:, 0], 1)
            found = [
                reconstruction(A, times(U, S), V.mT),
                max(orthogonality(X) for X in (U, V, R)),
                max(determinant(X, 1) for X in (U, V, R)),
                (angle(U.astype(np.float64) @ V.mT, Q) * gap).max(),
                (angle(R, Q) * gap).max(),
                reconstruction(A, times(X, x), Y.mT),
            ]
            worst = np.maximum(worst, found)
            nans += sum(int(np.isnan(X).sum()) for X in (U, S, V, R))
        *ours, other = (f"{value:.1e}" for value in worst)
        print(f"| {name} | {' | '.join(ours)} | {nans} | {other} |", flush=True)


def milliseconds(device, launch):
    """Median and 10th to 90th percentile of warm launches [ms]; on CUDA by events."""
    launch()
    found = []
    for _ in range(ROUNDS):
        if device.is_cuda:
            with wp.ScopedTimer("", print=False, cuda_filter=wp.TIMING_KERNEL, synchronize=True) as timer:
                launch()
            found.append(sum(result.elapsed for result in timer.timing_results))
        else:
            began = time.perf_counter()
            launch()
            found.append(1e3 * (time.perf_counter() - began))
    return np.percentile(found, [50, 10, 90])


def timings(count, device, dtype):
    """Time a matrix of svd3 of Warp, ours and the nearest rotation, in one run; on CUDA the share of the copy bandwidth too."""
    device = wp.get_device(device)
    scalar, matrix, vector = TYPES[dtype]
    size = wp.types.type_size_in_bytes(scalar)
    results = [wp.empty(count, dtype=kind, device=device) for kind in (matrix, vector, matrix)]
    plain = decompose.into_three(warp_svd3, matrix, (matrix, vector, matrix), 1)
    block = decompose.BLOCK if device.is_cuda else 1
    threads = -(-count // block) * block
    single = one(rotation.nearest_rotation, matrix, block)
    runs = [
        ("Warp's svd3", lambda A: wp.launch(plain, count, inputs=[A], outputs=results, device=device), 30 * size),
        ("svd", lambda A: decompose.launch(decompose.into_three, rotation.rotation_svd3, A, results), 30 * size),
        (
            "nearest rotation",
            lambda A: wp.launch(single, threads, inputs=[A], outputs=results[:1], device=device, block_dim=block),
            18 * size,
        ),
    ]
    copied = None
    if device.is_cuda:
        a, b = (wp.empty(256 * 2**20, dtype=wp.float32, device=device) for _ in range(2))
        took = []
        for _ in range(ROUNDS):
            with wp.ScopedTimer("", print=False, cuda_filter=wp.TIMING_MEMCPY, synchronize=True) as timer:
                wp.copy(b, a)
            took.append(sum(result.elapsed for result in timer.timing_results))
        copied = 2 * 2**30 / np.median(took) / 1e9
        print(f"copy: {copied:.2f} TB/s")
    print("| class | " + " | ".join(name for name, *_ in runs) + " |")
    print("|---|" + "---|" * len(runs))
    for name in CLASSES:
        A = samples(name, np.random.default_rng(0), min(count, CHUNK), np.dtype(dtype))
        A = wp.array(np.resize(A, (count, 3, 3)), dtype=matrix, device=device)
        cells, first = [], None
        for _, run, moved in runs:
            middle, low, high = milliseconds(device, partial(run, A))
            first = middle if first is None else first
            cell = f"{1e6 * middle / count:.3g} ns ({1e6 * low / count:.3g}–{1e6 * high / count:.3g}), {middle / first:.2f} ×"
            if copied:
                cell += f", {moved * count / middle / 1e9 / copied:.0%} of copy"
            cells.append(cell)
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("accuracy", "time"))
    parser.add_argument("--count", type=int)
    parser.add_argument("--dtype", choices=TYPES, default="float32")
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args()
    if options.what == "accuracy":
        accuracy(options.count or 10_000_000, options.dtype)
    else:
        timings(options.count or (200_000 if options.device == "cpu" else 10_000_000), options.device, options.dtype)


if __name__ == "__main__":
    main()
