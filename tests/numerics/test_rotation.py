"""Singular values and rotations of small matrices: bounds over random matrices of many classes, and the answers defined."""

import numpy as np
import pytest
import warp as wp

import warpcloth as wc
from support import matrices
from support.matrices import CLASSES, angle, determinant, orthogonality, reconstruction, reference, samples, times

COUNT = 10_000
# 17 ε and 45 ε. Ten to twenty operations, each rounded by ε/2, lie between a matrix and a number of the result.
BOUND = {np.float32: 2e-6, np.float64: 1e-14}
PRECISIONS = pytest.mark.parametrize("dtype", BOUND, ids=["float32", "float64"])
WARP = {np.float32: wp.float32, np.float64: wp.float64}


def on(device, A):
    """The matrices (n, rows, columns) as a Warp array of matrices."""
    return wp.array(A, dtype=wp.types.matrix(A.shape[1:], WARP[A.dtype.type]), device=device)


def numpy(arrays):
    return [array.numpy() for array in arrays]


@pytest.fixture(scope="module", params=BOUND, ids=["float32", "float64"])
def precision(request):
    return request.param


@pytest.mark.parametrize("name", CLASSES)
def test_3x3(name, precision, device):
    A, bound = samples(name, np.random.default_rng(3), COUNT, precision), BOUND[precision]
    R, signed = reference(A)
    largest = np.where(signed[:, 0] > 0, signed[:, 0], 1)
    gap = np.maximum(signed[:, 1] + signed[:, 2], 0.0) / largest

    U, S, V = numpy(wc.svd(on(device, A), convention="rotation"))
    assert reconstruction(A, times(U, S), V.mT) <= bound and max(orthogonality(U), orthogonality(V)) <= bound
    assert max(determinant(U, 1), determinant(V, 1)) <= bound
    assert (S[:, 0] >= S[:, 1]).all() and (S[:, 1] >= np.abs(S[:, 2])).all()
    assert (np.abs(S - signed) / largest[:, None]).max() <= bound and (angle(U @ V.mT, R) * gap).max() <= bound

    plain_U, plain_S, plain_V = numpy(wc.svd(on(device, A)))
    assert np.array_equal(plain_S, np.abs(S)) and np.array_equal(plain_V, V)
    assert np.array_equal(plain_U[:, :, :2], U[:, :, :2])
    assert determinant(plain_U, np.where(S[:, 2] < 0, -1, 1)) <= bound
    assert reconstruction(A, times(plain_U, plain_S), V.mT) <= bound

    nearest, P = numpy(wc.polar(on(device, A)))
    assert reconstruction(A, nearest, P) <= bound and np.array_equal(P, P.mT)
    assert max(orthogonality(nearest), determinant(nearest, 1)) <= bound
    assert (angle(nearest, R) * gap).max() <= bound


@pytest.mark.parametrize("name", CLASSES)
def test_3x2_and_2x2(name, precision, device):
    whole, bound = samples(name, np.random.default_rng(4), COUNT // 10, precision), BOUND[precision]
    for A in (np.ascontiguousarray(whole[:, :, :2]), np.ascontiguousarray(whole[:, :2, :2])):
        square = A.shape[1] == 2
        expected = np.linalg.svd(A.astype(np.float64), compute_uv=False)
        U, S, V = numpy(wc.svd(on(device, A), convention="rotation"))
        assert reconstruction(A, times(U, S), V.mT) <= bound
        assert max(orthogonality(U), orthogonality(V), determinant(V, 1)) <= bound
        assert (S[:, 0] >= np.abs(S[:, 1])).all()
        assert (np.abs(np.abs(S) - expected) / np.where(expected[:, :1] > 0, expected[:, :1], 1)).max() <= bound
        if square:
            assert determinant(U, 1) <= bound
        plain_U, plain_S, plain_V = numpy(wc.svd(on(device, A)))
        assert np.array_equal(plain_S, np.abs(S)) and np.array_equal(plain_V, V)
        assert np.array_equal(plain_U, np.where(S[:, None, :] < 0, -U, U))
        R, P = numpy(wc.polar(on(device, A)))
        assert reconstruction(A, R, P) <= bound and orthogonality(R) <= bound and np.array_equal(P, P.mT)
        if square:
            assert determinant(R, 1) <= bound


def least_rotations(v, u):
    """The least rotation that turns each v (n, 3) to u (n, 3): I + [w] + [w]²/(1 + u·v), w = v × u."""
    w = np.cross(v, u)
    skew = np.cross(np.eye(3)[None], w[:, None, :]).mT * -1.0
    return np.eye(3) + skew + skew @ skew / (1.0 + (u * v).sum(axis=1))[:, None, None]


@pytest.mark.parametrize("columns", [2, 3])
def test_rank_1_gives_the_least_rotation(columns, precision, device):
    rng = np.random.default_rng(6)
    u, v = rng.normal(size=(2, COUNT, 3))
    v[:, columns:] = 0.0
    A = (u[:, :, None] * v[:, None, :columns] * matrices.powers(rng, COUNT, -12, 12)[:, None, None]).astype(precision)
    u, v = (a / np.linalg.norm(a, axis=1, keepdims=True) for a in (u, v))
    found, least = numpy(wc.polar(on(device, A)))[:1], least_rotations(v, u)
    # The turn in the plane across u is that of a vector 1 + cos long: towards 180° it loses digits.
    well = (1.0 + (u * v).sum(axis=1)) / 2.0
    if columns == 3:
        U, _, V = numpy(wc.svd(on(device, A), convention="rotation"))
        assert all((angle(R, least) * well).max() <= BOUND[precision] for R in (*found, U @ V.mT))
    assert (np.linalg.norm(found[0] - least[:, :, :columns], axis=(1, 2)) * well).max() <= BOUND[precision] * (columns - 1)


@PRECISIONS
def test_defined_answers(dtype, device):
    """The identity of zero and of itself, exactly; half a turn where a line is turned round; axes of a diagonal."""
    opposite = np.diag([-1.0, 0.0, 0.0])
    A = np.stack([np.zeros((3, 3)), np.eye(3), 1e-30 * np.eye(3), opposite, np.diag([4.0, 2.0, 1.0])]).astype(dtype)
    for convention in ("plain", "rotation"):
        U, S, V = wc.svd(A, convention)
        assert np.array_equal(U[[0, 1, 2, 4]], V[[0, 1, 2, 4]]) and np.array_equal(V[0], np.eye(3))
        assert np.array_equal(S[[0, 1, 4]], [[0, 0, 0], [1, 1, 1], [4, 2, 1]])
    R, _ = wc.polar(A)
    assert np.array_equal(R[[0, 1, 2, 4]], np.stack([np.eye(3)] * 4))
    assert R[3, 0, 0] == -1.0 and determinant(R, 1) == 0.0
    for rows, columns in ((3, 2), (2, 2)):
        zero = np.zeros((1, rows, columns), dtype)
        U, S, V = wc.svd(zero)
        assert np.array_equal(U[0], np.eye(rows, columns)) and not S.any() and np.array_equal(V[0], np.eye(2))
        assert np.array_equal(wc.polar(zero)[0][0], np.eye(rows, columns))
    assert np.array_equal(wc.polar(np.diag([1.0, -1.0]).astype(dtype))[0], np.eye(2))  # any rotation is as near


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("shape", [(3, 3), (3, 2), (2, 2)])
@PRECISIONS
def test_nan_in_gives_nan_out(dtype, shape, bad, device):
    """In every number of every result, wherever in the matrix it is, and whatever else is there."""
    bases, entries = [np.random.default_rng(8).normal(size=shape), np.zeros(shape), np.eye(*shape)], shape[0] * shape[1]
    A = np.repeat(bases, entries, axis=0).astype(dtype)
    A.reshape(len(A), -1)[np.arange(len(A)), np.tile(np.arange(entries), 3)] = bad
    results = [*wc.svd(on(device, A)), *wc.svd(on(device, A), convention="rotation"), *wc.polar(on(device, A))]
    for result in results:
        assert np.isnan(result.numpy()).all()


@PRECISIONS
def test_polar_decomposition_does_not_overflow(dtype, device):
    largest = np.finfo(dtype).max
    for rows, columns in ((3, 3), (3, 2), (2, 2)):
        A = np.zeros((rows, columns), dtype)
        A[0, 0], A[1, 1] = 0.9 * largest, 1.0
        R, P = wc.polar(A)
        assert np.array_equal(R, np.eye(rows, columns)) and np.abs(P[0, 0] / A[0, 0] - 1.0) < BOUND[dtype]


@PRECISIONS
def test_the_ends_of_the_range(dtype, device):
    """Numbers so small that they have few digits, or so large that their squares overflow: no more is lost."""
    limits, rng = np.finfo(dtype), np.random.default_rng(9)
    for scale in (limits.smallest_subnormal * 1e3, limits.tiny, limits.max / 4):
        for shape in ((3, 3), (3, 2), (2, 2)):
            A = (rng.uniform(-1, 1, size=(1000, *shape)) * dtype(scale)).astype(dtype)
            wide = A.astype(np.longdouble) / np.longdouble(scale)
            U, S, V = (result.numpy() for result in wc.svd(on(device, A), convention="rotation"))
            S = (S.astype(np.longdouble) / np.longdouble(scale)).astype(np.float64)
            least = np.linalg.norm(wide.astype(np.float64), axis=(1, 2)).min()
            digits = max(BOUND[dtype], 3.0 * limits.smallest_subnormal / scale / least)
            assert reconstruction(wide.astype(np.float64), times(U, S), V.mT) <= digits
            assert max(orthogonality(U), orthogonality(V), determinant(V, 1)) <= BOUND[dtype]


@pytest.mark.parametrize("unequal", [1e-7, 1e-12, 1e-19, 1e-22, 1e-30, 1e-42])
def test_parts_far_below_rounding(unequal, device):
    """Squares of what is far below rounding underflow; the factors stay orthogonal to rounding."""
    x = unequal
    A = [[[1, 0, 0], [0, x, 0], [0, 0, x / 10]], [[1, x, 0], [0, 1, x / 3], [x / 7, 0, 1]]]
    A = np.array([*A, [[1, 0, 0], [0, 1, 0], [0, x, 1]], [[x, 1, 0], [1, x, x], [0, x / 2, x]]], np.float32)
    for shape in ((3, 3), (3, 2), (2, 2)):
        part = np.ascontiguousarray(A[:, : shape[0], : shape[1]])
        U, S, V = numpy(wc.svd(on(device, part), convention="rotation"))
        assert reconstruction(part, times(U, S), V.mT) <= BOUND[np.float32]
        assert max(orthogonality(U), orthogonality(V), determinant(V, 1)) <= BOUND[np.float32]


def test_kinds_of_arrays(device):
    """NumPy in, NumPy out; Warp in, Warp out on its device, of matrices as of numbers; any leading dimensions, strides too."""
    A = np.random.default_rng(10).normal(size=(4, 6, 3, 2))
    expected = wc.svd(A)
    assert [array.shape for array in expected] == [(4, 6, 3, 2), (4, 6, 2), (4, 6, 2, 2)]
    assert all(isinstance(array, np.ndarray) and array.dtype == np.float64 for array in expected)
    for given in (on(device, A.reshape(-1, 3, 2)).reshape((4, 6)), wp.array(A, dtype=wp.float64, device=device)):
        results = wc.svd(given)
        assert all(array.device == given.device for array in results)
        assert [array.dtype for array in wc.svd(wp.array(A, dtype=wp.float64, device=device))] == [wp.float64] * 3
        for result, array in zip(results, expected, strict=True):
            assert np.abs(result.numpy() - array).max() < 1e-14
    for result, array in zip(wc.svd(on(device, A.reshape(-1, 3, 2)).reshape((4, 6))[::2]), expected, strict=True):
        assert np.abs(result.numpy() - array[::2]).max() < 1e-14
    assert np.array_equal(wc.svd(A[:, ::-1])[1], expected[1][:, ::-1])
    assert wc.svd(A.astype(np.float32))[0].dtype == np.float32
    assert [array.shape for array in wc.svd([[1, 0], [0, 2]])] == [(2, 2), (2,), (2, 2)]
    assert [array.shape for array in wc.polar(np.zeros((0, 5, 3, 3)))] == [(0, 5, 3, 3), (0, 5, 3, 3)]
    assert wc.svd(wp.zeros(0, dtype=wp.mat33f, device=device))[1].shape == (0,)


@pytest.mark.parametrize(
    "wrong",
    [np.zeros((3, 4)), np.zeros((2, 3)), np.zeros(3), np.eye(3, dtype=complex), "text", np.eye(3, dtype=np.float16), None],
)
def test_wrong_matrices(wrong):
    for decomposed in (wc.svd, wc.polar):
        with pytest.raises(ValueError, match=r"^A has shape .* it must be \(…, 3, 3\) or \(…, 3, 2\) or \(…, 2, 2\) of"):
            decomposed(wrong)
    with pytest.raises(ValueError, match="convention is 'left'; it must be one of 'plain', 'rotation'"):
        wc.svd(np.eye(3), convention="left")


def points(rng, count, shape=(), dtype=np.float64):
    return rng.normal(size=(*shape, count, 3)).astype(dtype)


def test_kabsch_finds_the_rotation(precision, device):
    """Of point sets that were turned and moved, weighted or not, also 1000 sizes from the origin."""
    rng = np.random.default_rng(11)
    turns, P, weights = matrices.rotations(rng, 200), points(rng, 12).astype(precision), rng.uniform(size=12)
    for far, eps in ((0.0, 1.0), (1e3, 1e3)):
        X = (P + far).astype(precision)
        Q = ((X.astype(np.float64) - far) @ turns.mT - far).astype(precision)
        for w in (None, weights):
            R = wc.kabsch(X, Q, weights=w)
            assert R.shape == (200, 3, 3) and R.dtype == precision
            # Twelve points of size 1, rounded by ε·far.
            assert angle(R, turns).max() < 10.0 * eps * np.finfo(precision).eps
            assert max(orthogonality(R), determinant(R, 1)) < BOUND[precision]


def test_kabsch_against_the_svd_of_the_covariance(device):
    rng = np.random.default_rng(12)
    P, Q = points(rng, 30), points(rng, 30, (50,))
    w = rng.uniform(size=(50, 30))
    p = P - (w[..., None] * P).sum(axis=1, keepdims=True) / w.sum(axis=1)[:, None, None]
    q = Q - (w[..., None] * Q).sum(axis=1, keepdims=True) / w.sum(axis=1)[:, None, None]
    U, _, Vt = np.linalg.svd(np.einsum("fn,fni,fnj->fij", w, q, p))
    U[:, :, 2] *= (np.linalg.det(U) * np.linalg.det(Vt))[:, None]
    assert np.abs(wc.kabsch(P, Q, weights=w) - U @ Vt).max() < 1e-12
    sets = [rng.permutation(30)[: 4 + c % 5] for c in range(40)]
    R = wc.kabsch(P, Q, weights=w, neighbours=sets)
    assert R.shape == (50, 40, 3, 3)
    for c in (0, 7, 39):
        alone = wc.kabsch(P[sets[c]], Q[:, sets[c]], weights=w[:, sets[c]])
        assert np.array_equal(R[:, c], alone)


def test_kabsch_where_the_rotation_is_not_unique(device):
    """One point: the identity. Points on a line: the least rotation. In a plane: never the reflection."""
    rng = np.random.default_rng(13)
    P = points(rng, 5)
    assert np.array_equal(wc.kabsch(P[:1], P[1:2]), np.eye(3))
    t, (v, u) = np.linspace(-1, 1, 5)[:, None], rng.normal(size=(2, 3))
    v, u = v / np.linalg.norm(v), u / np.linalg.norm(u)
    assert np.abs(wc.kabsch(t * v, t * u) - least_rotations(v[None], u[None])[0]).max() < 1e-14
    flat, turn = P * [1.0, 1.0, 0.0], matrices.rotations(rng, 1)[0]
    assert np.abs(wc.kabsch(flat, flat @ turn.T) - turn).max() < 1e-14
    assert determinant(wc.kabsch(P, P * [1.0, 1.0, -1.0])[None], 1) < 1e-14
    for bad in (np.nan, np.inf):  # a set of one point says nothing of its rotation, but must not hide it
        wrong, right = [[bad, 0, 0]], [[0.0, 0, 0]]
        assert np.isnan(wc.kabsch(wrong, right)).all() and np.isnan(wc.kabsch(right, wrong)).all()
    assert np.isnan(wc.kabsch([[1.0, 0, 0]], [[0.0, 0, 0]], weights=[np.nan])).all()
    broken = P.copy()
    broken[3, 1] = np.nan
    R = wc.kabsch(P, np.stack([P, broken]))
    assert np.isnan(R[1]).all() and np.isfinite(R[0]).all()
    R = wc.kabsch(P, broken, neighbours=[[0, 1, 2], [1, 2, 3]])
    assert np.isnan(R[1]).all() and np.isfinite(R[0]).all()


def test_kabsch_does_without_points_of_weight_0_and_without_a_scale(precision, device):
    """Points without weight, the first among them, may be anywhere; small or large values are not squared."""
    rng = np.random.default_rng(15)
    turn, P = matrices.rotations(rng, 1), points(rng, 6).astype(precision)
    bound, far = 40.0 * np.finfo(precision).eps, np.concatenate([[[1e8, 1e8, -1e8]], P]).astype(precision)
    Q = np.concatenate([[[0.0, 0.0, 0.0]], P.astype(np.float64) @ turn[0].T]).astype(precision)
    assert angle(wc.kabsch(far, Q, weights=[0, 1, 1, 1, 1, 1, 1])[None], turn)[0] < bound
    for scale in (1e-22, 1e-30, 1e20, 1e30) if precision is np.float32 else (1e-170, 1e-250, 1e160, 1e250):
        X, Y = ((a * precision(scale)).astype(precision) for a in (P, Q[1:]))
        for w in (None, np.full(6, 1e-30), np.full(6, 1e30)):
            assert angle(wc.kabsch(X, Y, weights=w)[None], turn)[0] < bound


def test_kabsch_of_warp_arrays(device):
    rng = np.random.default_rng(14)
    P, Q = points(rng, 20, (3,), np.float32), points(rng, 20, (3,), np.float32)
    sets = np.stack([rng.permutation(20)[:6] for _ in range(20)])
    expected = wc.kabsch(P, Q, neighbours=sets)
    vectors = [wp.array(a, dtype=wp.vec3, device=device) for a in (P, Q)]
    R = wc.kabsch(*vectors, neighbours=wp.array(sets.astype(np.int32), device=device))
    assert R.shape == (3, 20) and R.device == vectors[0].device and np.abs(R.numpy() - expected).max() < 1e-5
    numbers = [wp.array(a, dtype=wp.float32, device=device) for a in (P, Q)]
    R = wc.kabsch(*numbers, neighbours=sets)
    assert R.shape == (3, 20, 3, 3) and np.abs(R.numpy() - expected).max() < 1e-5


_P = np.eye(3)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"Q": np.zeros((2, 3))}, r"P has shape \(3, 3\) and Q \(2, 3\); both must be"),
        ({"Q": np.zeros((3, 2))}, r"Q has shape \(3, 2\) and type"),
        ({"Q": _P.astype(np.float32)}, "P is a NumPy array of float64 on cpu and Q a NumPy array of float32"),
        ({"P": np.zeros((0, 3)), "Q": np.zeros((0, 3))}, "with one n above 0"),
        ({"P": np.zeros(3), "Q": np.zeros(3)}, "with one n above 0"),
        ({"P": np.zeros((2, 3, 3)), "Q": np.zeros((4, 3, 3))}, r"leading dimensions \(2,\), \(4,\) and \(\); they must fit"),
        ({"weights": [1, 1]}, r"weights has shape \(2,\); it must be \(3,\) or"),
        ({"weights": [1, -1, 1]}, r"weights\[1\] is -1.0; it must be 0 or more"),
        ({"weights": [0, 0, 0]}, "weights of a set of points are all 0"),
        ({"weights": [0, 0, 1], "neighbours": [[1, 2], [0, 1]]}, "weights of a set of points are all 0"),
        ({"P": _P.astype(np.float32), "Q": _P.astype(np.float32), "weights": [1e-50] * 3}, "are all 0 in float32"),
        ({"neighbours": {5: "a"}}, r"neighbours\[0\] is 5; it must be"),
        ({"P": [[1, 2], [3]]}, "P has shape"),
        ({"weights": "even"}, "weights is 'even', which is not numeric"),
        ({"neighbours": [[0, 1], []]}, r"neighbours\[1\] is \[\]; it must be an array \(C, k\) of indices or C lists"),
        ({"neighbours": [[0, 1], [2, 3]]}, r"neighbours\[1\] has 3; it must be an index of the 3 points"),
        ({"neighbours": [[0, 1.5]]}, r"neighbours\[0\] is \[0, 1.5\]; it must be"),
        ({"neighbours": [0, 1]}, r"neighbours\[0\] is 0; it must be"),
        ({"neighbours": 3}, "neighbours is 3; it must be"),
    ],
)
def test_wrong_points(arguments, says):
    with pytest.raises(ValueError, match=says):
        wc.kabsch(**({"P": _P, "Q": _P} | arguments))
