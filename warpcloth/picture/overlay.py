"""Draws the colour bar, names and the time on pictures."""

import unicodedata
from functools import cached_property

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from .colour import EXCLUDED

INK = (64, 64, 68)
# Height of letters relative to that of the picture, or to 9/16 of its width; and the smallest legible height [px].
_LETTERS, _MIN_LETTERS = 0.03, 10
# Height of the bar relative to that of the picture, and largest width of everything around it relative to its width.
_BAR, _WIDEST = 0.56, 0.4


class Overlay:
    """Draws on pictures of one size.

    Args:
        size: Width and height [px].
        scale: The :class:`Scale` of the bar, or None.
        names: Names of panels side by side, or empty.
        background: Its sRGB, 0 to 255.
        columns: Panels in a row; None for all.
    """

    def __init__(self, size, scale=None, title="", unit="1", names=(), background=(255, 255, 255), columns=None):
        self.width, self.height = size
        self.columns = columns
        self.scale, self.title, self.unit = scale, written(title), written(unit)
        self.names, self.background = [written(name) for name in names], tuple(background)
        self.letters = max(_MIN_LETTERS, round(_LETTERS * min(self.height, self.width * 9 / 16)))
        self._font = ImageFont.load_default(self.letters)

    @cached_property
    def beside(self):
        """Width of the bar's space, right of the picture [px]."""
        if self.scale is None:
            return 0
        em, labels = self.letters, [self._length(text) for _, text in self._ticks]
        bar = 0.5 * em + 0.9 * em + 0.4 * em + max(labels, default=0) + 0.6 * em
        head = max((self._length(line) for line in self._head), default=0) + 1.1 * em
        return int(min(np.ceil(max(bar, head)), _WIDEST * self.width))

    @cached_property
    def _ticks(self):
        room = _BAR * self.height / (2.4 * self.letters)
        return bar_ticks(self.scale, max(2, min(6, int(room))))

    @cached_property
    def _head(self):
        lines, widest = [""], max(8 * self.letters, 0.16 * self.width)
        for part in self.title.replace("_", "_\n").split("\n"):
            if lines[-1] and self._length(lines[-1] + part) > widest:
                lines.append("")
            lines[-1] += part
        unit = bar_unit(self.scale, self.unit)
        return [*lines, f"[{unit}]"] if unit else lines

    def _length(self, text):
        return self._font.getlength(text)

    def draw(self, panels, time=None, excluded=False):
        """Returns a Pillow image of panels (height, width, 3) uint8 in rows, with the bar, names, time, and the colour of
        missing values.
        """
        canvas = Image.new("RGB", (self.width, self.height), self.background)
        pen = ImageDraw.Draw(canvas)
        left, top, em = 0, 0, self.letters
        for k, panel in enumerate(panels):
            if self.columns and k and k % self.columns == 0:
                left, top = 0, top + panels[k - 1].shape[0]
            tall, wide = panel.shape[:2]
            canvas.paste(Image.fromarray(panel), (left, top))
            if left:
                pen.line([(left, top), (left, top + tall)], (205, 207, 210), max(1, em // 12))
            if k < len(self.names):
                room = min(wide, self.width - self.beside - left) - 1.2 * em  # not over the bar
                self._write(pen, (left + 0.6 * em, top + 0.5 * em), self._short(self.names[k], room), "la")
            left += wide
        if time is not None:
            self._write(pen, (0.6 * em, self.height - 0.5 * em), time, "ld")
        if self.scale is not None:
            self._draw_bar(pen, excluded)
        return canvas

    def _write(self, pen, position, text, anchor="lm"):
        rim = max(1, self.letters // 8)
        pen.text(position, text, INK, self._font, anchor, stroke_width=rim, stroke_fill=self.background)

    def _short(self, text, room):
        while len(text) > 1 and self._length(text) > room:
            text = text[:-2].rstrip("…") + "…"
        return text

    def _draw_bar(self, pen, excluded):
        em, left = self.letters, self.width - self.beside
        tall = max(2, round(_BAR * self.height))
        top = (self.height - tall) // 2
        bottom, start, end = top + tall, left + round(0.5 * em), left + round(1.4 * em)
        colours = self.scale.srgb(np.linspace(self.scale.high, self.scale.low, tall))
        colours = np.round(255.0 * colours).astype(int)
        for row, colour in enumerate(colours):
            pen.line([(start, top + row), (end - 1, top + row)], tuple(colour.tolist()))
        tip = round(0.55 * em)  # arrows for values beyond the ends, which have the colours of the ends
        for at, beyond, colour in ((top - 1, top - tip, colours[0]), (bottom, bottom + tip, colours[-1])):
            pen.polygon([(start, at), (end - 1, at), ((start + end - 1) / 2, beyond)], tuple(colour.tolist()))
        for value, text in self._ticks:
            y = bottom - (value - self.scale.low) / (self.scale.high - self.scale.low) * tall
            pen.line([(end, y), (end + 0.2 * em, y)], INK, max(1, em // 14))
            pen.text((end + 0.4 * em, y), text, INK, self._font, "lm")
        y = top - tip - 0.7 * em
        for line in self._head[::-1]:
            pen.text((start, y), line, INK, self._font, "ls")
            y -= 1.25 * em
        if excluded:
            y = bottom + tip + 1.2 * em
            pen.rectangle([start, y - 0.4 * em, start + 0.8 * em, y + 0.4 * em], tuple(round(255 * c) for c in EXCLUDED))
            pen.text((start + 1.2 * em, y), "no value", INK, self._font, "lm")


def bar_ticks(scale, most):
    """Returns values and labels of at most some ticks of a bar; labels are divided by a power of ten."""
    values = round_numbers(scale.low, scale.high, most)
    factor = 10.0 ** _exponent(scale)
    step = float(np.diff(values).min()) / factor if len(values) > 1 else abs(values[0] / factor) or 1.0
    digits = int(max(0, -np.floor(np.log10(step) + 1e-9), -np.floor(np.log10(step * 10) + 1e-9)))
    while digits and all(f"{value / factor:.{digits}f}".endswith("0") for value in values):
        digits -= 1
    # With a hyphen for negative values, because the font has no minus sign.
    return [(value, f"{value / factor:.{digits}f}") for value in values]


def bar_unit(scale, unit):
    """Returns the text of the power of ten and unit of a bar, or ""."""
    exponent = _exponent(scale)
    return " ".join(filter(None, (f"1e{exponent}" if exponent else "", "" if unit == "1" else unit)))


def _exponent(scale):
    most = max(abs(scale.low), abs(scale.high))
    exponent = 3 * int(np.floor(np.log10(most) / 3.0)) if most > 0.0 else 0
    return exponent if not -3 < exponent < 6 else 0


def written(text):
    """Returns text in the built-in font: m^2 for m², e for é, ? for others."""
    powers = text.translate(str.maketrans({"²": "^2", "³": "^3", "⁻": "-", "−": "-", "×": "x"}))
    decomposed = "".join(c for c in unicodedata.normalize("NFKD", powers) if not unicodedata.combining(c))
    return "".join(c if c.isascii() or c in "°·…" else "?" for c in decomposed)


def round_numbers(low, high, most):
    """Returns at most ``most`` multiples of 1, 2 or 5 times a power of ten in [low, high], or low and high."""
    rough = (high - low) / most
    power = 10.0 ** np.floor(np.log10(rough))
    for factor in (1.0, 2.0, 5.0, 10.0, 20.0, 50.0):
        step = factor * power
        first, last = np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9)
        if last - first + 1 <= most:
            break
    found = step * np.arange(first, last + 1) + 0.0  # no −0
    return found if len(found) > 1 else np.array([low, high])
