"""Kernels that find the pattern of a sparse matrix of blocks: a sum of element matrices, or a product.

A corner q is an index into the vertices of all elements, which have K vertices or are cells. Its matrix row has one block for
each vertex of its element, and a diagonal block; rows and columns of fixed vertices have only that.
"""

from functools import cache

import warp as wp

MODULE = "warpcloth.block_pattern"


@wp.struct
class Corners:
    """The corners of the elements of one term.

    Attributes:
        vertices: Vertices of all elements.
        offsets, codes: The corners of each vertex, ascending.
        K: Number of vertices of an element, or 0 for cells.
        firsts: For cells, the first corner of each corner's cell.
        sizes: For cells, the number of vertices of that cell.
        starts: For cells, the first block of each corner among all; K·q for elements.
    """

    vertices: wp.array(dtype=wp.int32)
    offsets: wp.array(dtype=wp.int32)
    codes: wp.array(dtype=wp.int32)
    K: int
    firsts: wp.array(dtype=wp.int32)
    sizes: wp.array(dtype=wp.int32)
    starts: wp.array(dtype=wp.int32)


@wp.func
def element_of(corners: Corners, q: int):
    """The first corner of q's element, its number of vertices, and the first block of q."""
    size = int(corners.K)
    if size > 0:
        return q // size * size, size, size * q
    return corners.firsts[q], corners.sizes[q], corners.starts[q]


@wp.func
def find_column(columns: wp.array(dtype=wp.int32), first: int, last: int, column: int):
    """Index of the first of ascending columns[first : last] that is not below ``column``."""
    low, high = int(first), int(last)
    while low < high:
        middle = (low + high) // 2
        if columns[middle] < column:
            low = middle + 1
        else:
            high = middle
    return low


@wp.func
def insert_column(columns: wp.array(dtype=wp.int32), start: int, count: int, column: int):
    """Inserts a column into the ascending columns[start : start + count] if it is missing; returns their number."""
    last = start + count
    index = find_column(columns, start, last, column)
    if index < last and columns[index] == column:
        return count
    for after in range(last - index):
        columns[last - after] = columns[last - after - 1]
    columns[index] = column
    return count + 1


@cache
def add_diagonal():
    """Kernel over vertices: the first column, at ``firsts``, is the vertex itself."""

    @wp.kernel(module=MODULE, enable_backward=False)
    def add_each_diagonal(
        # parameters
        firsts: wp.array(dtype=wp.int32),
        # out
        columns: wp.array(dtype=wp.int32),
        counts: wp.array(dtype=wp.int32),
    ):
        i = wp.tid()
        columns[firsts[i]] = i
        counts[i] = 1

    return add_each_diagonal


@cache
def add_columns():
    """Kernel over vertices: adds the columns of a term to the ascending ones from ``firsts`` on, and counts its blocks."""

    @wp.kernel(module=MODULE, enable_backward=False)
    def add_each_column(
        # elements
        fixed: wp.array(dtype=wp.int32),
        corners: Corners,
        # parameters
        firsts: wp.array(dtype=wp.int32),
        # in and out
        columns: wp.array(dtype=wp.int32),
        counts: wp.array(dtype=wp.int32),
        # out
        blocks: wp.array(dtype=wp.int32),
    ):
        i = wp.tid()
        start, count, total = firsts[i], int(counts[i]), wp.int32(0)
        if fixed[i] == 0:
            for n in range(corners.offsets[i], corners.offsets[i + 1]):
                first, size, _start = element_of(corners, corners.codes[n])
                for k in range(first, first + size):
                    j = corners.vertices[k]
                    if fixed[j] == 0:
                        total += 1
                        count = insert_column(columns, start, count, j)
        counts[i] = count
        blocks[i] = total

    return add_each_column


@cache
def add_product_columns():
    """Kernel over rows: the ascending columns of a product of two sparse matrices from ``firsts`` on, and their number."""

    @wp.kernel(module=MODULE, enable_backward=False)
    def add_columns_of_product(
        # elements
        left_offsets: wp.array(dtype=wp.int32),
        left_columns: wp.array(dtype=wp.int32),
        right_offsets: wp.array(dtype=wp.int32),
        right_columns: wp.array(dtype=wp.int32),
        # parameters
        firsts: wp.array(dtype=wp.int32),
        # out
        columns: wp.array(dtype=wp.int32),
        counts: wp.array(dtype=wp.int32),
    ):
        i = wp.tid()
        start, count = firsts[i], wp.int32(0)
        for s in range(left_offsets[i], left_offsets[i + 1]):
            k = left_columns[s]
            for t in range(right_offsets[k], right_offsets[k + 1]):
                count = insert_column(columns, start, count, right_columns[t])
        counts[i] = count

    return add_columns_of_product


@cache
def pack_columns():
    """Kernel over vertices: columns without gaps between rows, their row, and the diagonal block."""

    @wp.kernel(module=MODULE, enable_backward=False)
    def pack_each_column(
        # elements
        firsts: wp.array(dtype=wp.int32),
        offsets: wp.array(dtype=wp.int32),
        # state in
        columns: wp.array(dtype=wp.int32),
        # out
        packed: wp.array(dtype=wp.int32),
        rows: wp.array(dtype=wp.int32),
        diagonal: wp.array(dtype=wp.int32),
    ):
        i = wp.tid()
        for n in range(offsets[i + 1] - offsets[i]):
            j = columns[firsts[i] + n]
            packed[offsets[i] + n] = j
            rows[offsets[i] + n] = i
            if j == i:
                diagonal[i] = offsets[i] + n

    return pack_each_column


@cache
def list_blocks():
    """Kernel over vertices: the blocks of a term, ascending, that add up to each block of the row, and where they end."""

    @wp.kernel(module=MODULE, enable_backward=False)
    def list_each_block(
        # elements
        fixed: wp.array(dtype=wp.int32),
        corners: Corners,
        offsets: wp.array(dtype=wp.int32),
        columns: wp.array(dtype=wp.int32),
        # parameters
        firsts: wp.array(dtype=wp.int32),
        # out
        ends: wp.array(dtype=wp.int32),
        sources: wp.array(dtype=wp.int32),
    ):
        i = wp.tid()
        first_block, last_block = offsets[i], offsets[i + 1]
        for s in range(first_block, last_block):
            ends[s] = 0
        if fixed[i] == 0:
            for n in range(corners.offsets[i], corners.offsets[i + 1]):
                first, size, _start = element_of(corners, corners.codes[n])
                for k in range(first, first + size):
                    j = corners.vertices[k]
                    if fixed[j] == 0:
                        s = find_column(columns, first_block, last_block, j)
                        ends[s] = ends[s] + 1
        before = int(firsts[i])
        for s in range(first_block, last_block):
            count = ends[s]
            ends[s] = before
            before += count
        if fixed[i] == 0:
            for n in range(corners.offsets[i], corners.offsets[i + 1]):
                first, size, start = element_of(corners, corners.codes[n])
                for k in range(first, first + size):
                    j = corners.vertices[k]
                    if fixed[j] == 0:
                        s = find_column(columns, first_block, last_block, j)
                        sources[ends[s]] = start + k - first
                        ends[s] = ends[s] + 1

    return list_each_block


@cache
def set_slots():
    """Kernel over blocks s of the matrix: slots[q] = s for each block q of a term in its sum."""

    @wp.kernel(module=MODULE, enable_backward=False)
    def set_each_slot(
        # elements
        offsets: wp.array(dtype=wp.int32),
        sources: wp.array(dtype=wp.int32),
        # out
        slots: wp.array(dtype=wp.int32),
    ):
        s = wp.tid()
        for n in range(offsets[s], offsets[s + 1]):
            slots[sources[n]] = s

    return set_each_slot
