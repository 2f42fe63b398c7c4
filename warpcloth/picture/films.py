"""Writes pictures as a still or a film; equal pictures give equal bytes."""

import importlib.util
import io
import math
import struct
from fractions import Fraction
from pathlib import Path

import numpy as np
from PIL import Image

from ..base.outputs import Output, check_replaceable

STILL, FILMS = ".png", (".gif", ".webp", ".mp4")
# Browsers show frames of these that are shorter than this [s] for 0.1 s.
IN_PAGES, SHORTEST = (".gif", ".webp"), 0.02
# H.264 quality at which fine folds and the edges of letters stay clean; the default crf is 23. The mbtree rate control reads
# uninitialised memory, so that bytes would vary.
_QUALITY = {"crf": "16", "preset": "slow", "x264-params": "mbtree=0"}
# IEC 61966-2-1 (sRGB) on the primaries of Rec. 709, with the matrix of Rec. 709, 16 to 235.
_PRIMARIES, _TRANSFER, _MATRIX, _RANGE = 1, 13, 1, 1
# Shortest and longest time [s] that a picture can be shown. A GIF stores hundredths of seconds in 16 bits, a WebP thousandths
# in 24 bits.
_INTERVALS = {".gif": (0.01, 655.0), ".webp": (0.001, 16777.0), ".mp4": (1e-6, 1000.0)}
# Quality of a WebP at which the edges of letters stay clean, and the slowest of its searches, which makes the smallest files.
_WEBP = {"quality": 82, "method": 6}
# Bins per channel in which the colours of a GIF are counted.
_BINS = 64


def check_film(path, size):
    """Checks that a picture or film of a size [px] can be written.

    Raises:
        OSError: The folder does not exist, or cannot be written.
        ImportError: PyAV, which writes films, is not installed.
        ValueError: The ending or the size is not supported, or the path is a folder or a device.
    """
    path, (width, height) = Path(path), size
    if path.suffix.lower() not in (STILL, *FILMS):
        raise ValueError(f"{path}: the ending is {path.suffix!r}; it must be {', '.join((STILL, *FILMS[:-1]))} or {FILMS[-1]}")
    check_replaceable(path)
    if path.suffix.lower() == ".mp4":
        if width % 2 or height % 2:
            even = f"{width + width % 2}x{height + height % 2}"
            raise ValueError(f"size is {width}x{height}; a film in .mp4 must have even numbers, such as {even}")
        if not importlib.util.find_spec("av"):
            raise ImportError("films in .mp4 need PyAV: pip install -e '.[video]' in the checkout; the others need nothing")


def check_times(path, times):
    """Checks that a film can store the times of its pictures (F,) [s]."""
    ending, intervals = Path(path).suffix.lower(), np.diff(times)
    if not len(intervals) or ending not in _INTERVALS:
        return
    found = intervals.max() if ending in IN_PAGES else intervals.min()
    least, most = _INTERVALS[ending]
    if not least <= found <= most:
        rule = f"a {ending} can show one for {least:g} to {most:g} s, so that speed must be another"
        raise ValueError(f"{path}: a picture would be shown for {found:.3g} s; {rule}")


def open_film(path, size, times):
    """Opens a .png, .gif, .webp or .mp4 file for Pillow images at ascending times (F,) [s]; the last lasts as long as the one
    before.
    """
    kind = {".png": _Still, ".gif": _Gif, ".webp": _WebP, ".mp4": _Video}[Path(path).suffix.lower()]
    return kind(path, size, np.asarray(times, dtype=float))


class _Still(Output):
    def __init__(self, path, size, times):
        super().__init__(path, "xb")
        self.frames = 0

    def add(self, image):
        image.save(self.file, "PNG")
        self.frames += 1


class _Gif(Output):
    """A looping GIF with one palette, so that static regions are stored once.

    Frames are kept as PNG until the palette is known.
    """

    def __init__(self, path, size, times):
        super().__init__(path, "xb")
        self._times, self._held = times, []
        self._pixels, self._sums = np.zeros(_BINS**3, np.int64), np.zeros((_BINS**3, 3))

    @property
    def frames(self):
        return len(self._held)

    def add(self, image):
        values = np.asarray(image).reshape(-1, 3)
        bins = (values.astype(np.int64) * _BINS // 256) @ (_BINS**2, _BINS, 1)
        self._pixels += np.bincount(bins, minlength=len(self._pixels))
        for channel in range(3):
            self._sums[:, channel] += np.bincount(bins, values[:, channel], len(self._pixels))
        held = io.BytesIO()
        image.save(held, "PNG", compress_level=1)
        self._held.append(held.getvalue())

    def finish(self):
        count = len(self._held)
        if not count:
            return
        palette = self._palette()
        images = (self._image(k).quantize(palette=palette, dither=Image.Dither.NONE) for k in range(count))
        first = next(images)
        shown = durations(self._times[:count])
        first.save(self.file, "GIF", save_all=True, append_images=images, duration=shown, loop=0, optimize=False)

    def _image(self, k):
        return Image.open(io.BytesIO(self._held[k])).convert("RGB")

    def _palette(self):
        colours, found = np.nonzero(self._pixels)[0], self._pixels[self._pixels > 0]
        means = np.round(self._sums[colours] / found[:, None]).astype(np.uint8)
        rows = np.repeat(means, np.ceil(np.sqrt(found / found.min())).astype(int), axis=0)
        rows = np.resize(rows, (-(-len(rows) // 256) * 256, 3))
        sample = Image.fromarray(rows.reshape(-1, 256, 3))
        palette = Image.new("P", (1, 1))
        palette.putpalette(sample.quantize(256, Image.Quantize.MEDIANCUT).getpalette())
        return palette


def durations(times, ticks=100):
    """Returns durations of frames [ms] in whole ticks, ``ticks`` a second, that add up to the times."""
    last = times[-1] - times[-2] if len(times) > 1 else 1.0
    ends = np.floor(ticks * (np.append(times, times[-1] + last) - times[0]) + 0.5).astype(int)
    return (1000 // ticks * np.diff(ends)).tolist()


class _WebP(Output):
    """A looping WebP, written frame by frame: stills of the rectangle that changes."""

    def __init__(self, path, size, times):
        super().__init__(path, "xb")
        self._size, self._times = size, times
        self._stills, self._last = [], None

    @property
    def frames(self):
        return len(self._stills)

    def add(self, image):
        pixels = np.asarray(image)
        changed = np.ones(pixels.shape[:2], bool) if self._last is None else (pixels != self._last).any(axis=2)
        self._last, still = pixels.copy(), io.BytesIO()
        rows, columns = (np.flatnonzero(changed.any(axis=axis)) for axis in (1, 0))
        # A frame that does not change is its first pixels again. A rectangle starts at even coordinates.
        left, top = (int(each[0]) // 2 * 2 if len(each) else 0 for each in (columns, rows))
        right, bottom = (int(each[-1]) + 1 if len(each) else 2 for each in (columns, rows))
        image.crop((left, top, right, bottom)).save(still, "WEBP", **_WEBP)
        self._stills.append(((left // 2, top // 2, right - left - 1, bottom - top - 1), still.getvalue()[12:]))

    def finish(self):
        if not self._stills:
            return
        width, height = self._size
        shown = durations(self._times[: len(self._stills)], 1000)
        body = _chunk(b"VP8X", bytes([2, 0, 0, 0]) + _threes(width - 1, height - 1)) + _chunk(b"ANIM", bytes(6))
        for (rectangle, still), duration in zip(self._stills, shown, strict=True):
            body += _chunk(b"ANMF", _threes(*rectangle, duration) + bytes([2]) + still)  # in place of what was there
        self.file.write(_chunk(b"RIFF", b"WEBP" + body))


def _chunk(name, data):
    return name + struct.pack("<I", len(data)) + data + bytes(len(data) % 2)


def _threes(*numbers):
    return b"".join(number.to_bytes(3, "little") for number in numbers)


class _Video(Output):
    """A film in H.264, by one thread, so that equal pictures give equal bytes."""

    def __init__(self, path, size, times):
        import av

        super().__init__(path, "xb")
        self.frames = 0
        intervals = np.diff(times)
        rate = Fraction(1.0 / float(intervals.min()) if len(intervals) else 24.0).limit_denominator(1001)
        # If frames are missing, the one before is shown longer.
        self._counts = [math.floor(float(time - times[0]) * rate + 0.5) for time in times]
        self._av, self._tick = av, 1 / rate
        # By name, because at the end PyAV opens it again to move the index to the front.
        self._container = av.open(self.file.name, "w", format="mp4", options={"movflags": "+faststart"})
        self._stream = self._container.add_stream("libx264", rate=rate, options=_QUALITY)
        self._stream.width, self._stream.height = size
        self._stream.pix_fmt = "yuv420p"
        context = self._stream.codec_context
        context.thread_count, context.time_base = 1, self._tick
        context.color_primaries, context.color_trc, context.colorspace = _PRIMARIES, _TRANSFER, _MATRIX
        context.color_range = _RANGE

    def add(self, image):
        frame = self._av.VideoFrame.from_ndarray(np.asarray(image), format="rgb24")
        frame = frame.reformat(format="yuv420p", dst_colorspace=_MATRIX, dst_color_range=_RANGE)
        frame.pts, frame.time_base = self._counts[self.frames], self._tick
        self._container.mux(self._stream.encode(frame))
        self.frames += 1

    def finish(self):
        self._container.mux(self._stream.encode())
        self._container.close()

    def parts(self):
        return (self._container,)
