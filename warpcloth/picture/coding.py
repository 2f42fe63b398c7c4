"""Codes positions and values of an animation for pages: whole numbers, their differences, deflated."""

import base64
import zlib

import numpy as np

# Steps into which the longest side of the box of a motion is divided, and the code of a position that is not known.
STEPS, NOWHERE = 65534, 65535
# Steps of the range of a scale. Codes are 1 more, because 0 stands for no value.
LEVELS = 254


class Deflated:
    """Bytes that are deflated (RFC 1951) as they are added.

    Attributes:
        size: Number of bytes so far, as base64.
    """

    def __init__(self):
        self._deflate, self._parts, self.size = zlib.compressobj(wbits=-zlib.MAX_WBITS), [], 0

    def add(self, data):
        self._keep(self._deflate.compress(data))

    def text(self):
        """Ends the data, and returns them as base64."""
        self._keep(self._deflate.flush())
        return base64.b64encode(b"".join(self._parts)).decode()

    def _keep(self, part):
        self._parts.append(part)
        self.size += 4 * len(part) // 3


class CodedPositions(Deflated):
    """Positions as multiples of a quantum from the lower corner of a box, 16 bits each.

    A frame is predicted from the two before it at constant velocity. The difference of each vertex is relative to that of the
    vertex before, modulo 2¹⁶. Then 0, −1, 1, −2 become 0, 1, 2, 3, and the upper bytes of a frame come before the lower.

    Args:
        low: Lower corner of the box (3,) [m].
        quantum: The quantum [m], above 0. Positions beyond `STEPS` of it, or not finite, are unknown.
    """

    def __init__(self, low, quantum):
        super().__init__()
        self.low, self.quantum = np.asarray(low, dtype=np.float64), quantum
        self._before = None

    def append(self, points):
        """Adds a frame (n, 3) [m]."""
        with np.errstate(invalid="ignore", over="ignore"):
            steps = np.rint((points - self.low) / self.quantum)
            known = ((steps >= 0) & (steps <= STEPS)).all(axis=1)
        codes = np.where(known[:, None], steps, NOWHERE).astype(np.uint16).T
        last, other = self._before or (np.zeros_like(codes),) * 2
        change = codes - (2 * last - other)
        change[:, 1:] -= change[:, :-1].copy()
        folded = (change << 1) ^ np.where(change >= 1 << 15, NOWHERE, 0).astype(np.uint16)
        self.add((folded >> 8).astype(np.uint8).tobytes() + (folded & 255).astype(np.uint8).tobytes())
        self._before = (codes, codes if self._before is None else last)


class CodedValues(Deflated):
    """Values as steps of the range of a :class:`Scale`, 8 bits each, as differences from the frame before, modulo 2⁸.

    Values beyond an end are at the end; 0 is NaN.
    """

    def __init__(self, scale):
        super().__init__()
        self._scale, self._before = scale, np.uint8(0)

    def append(self, values):
        """Adds the values (E,) of a frame."""
        low, high = self._scale.low, self._scale.high
        levels = np.rint((np.clip(values, low, high) - low) / (high - low) * LEVELS) + 1.0
        codes = np.where(np.isnan(levels), 0.0, levels).astype(np.uint8)
        self.add((codes - self._before).tobytes())
        self._before = codes


def coded_indices(rows):
    """Returns indices (m, k) below 2³¹ as base64 of deflated int32 differences between rows."""
    data = Deflated()
    data.add(np.diff(rows.astype("<i4"), axis=0, prepend=np.int32(0)).tobytes())
    return data.text()
