"""Figures of matplotlib without pyplot's global state."""

import importlib.util
from io import BytesIO
from pathlib import Path

from ..base.outputs import OutputSet, check_replaceable

GREY = "0.35"
PICTURES = (".png", ".svg", ".pdf")
# Without the date the same figure has the same bytes.
_METADATA = {".png": {}, ".svg": {"Date": None}, ".pdf": {"CreationDate": None}}


def require_matplotlib():
    """Checks that matplotlib is installed.

    Raises:
        ImportError: matplotlib is not installed.
    """
    if not importlib.util.find_spec("matplotlib"):
        raise ImportError("colours and charts need matplotlib: pip install -e '.[chart]' in the checkout")


def check_path(path, endings):
    """Checks that a picture can be written.

    Raises:
        OSError: The folder does not exist, or cannot be written.
        ImportError: matplotlib is not installed.
        ValueError: The ending is another, or the path is a folder or a device.
    """
    require_matplotlib()
    path = Path(path)
    if path.suffix.lower() not in endings:
        raise ValueError(f"{path}: the ending is {path.suffix!r}; it must be {' or '.join(endings)}")
    check_replaceable(path)


def number_axis(axis):
    """Labels a logarithmic axis of less than two decades."""
    from matplotlib.ticker import LogLocator, MaxNLocator

    low, high = axis.get_view_interval()
    if high < 100.0 * low:
        ticks = LogLocator(subs=(1.0, 3.0)) if high > 10.0 * low else MaxNLocator(4)
        axis.set(major_locator=ticks, major_formatter="{x:g}", minor_formatter="")


def save(figure, path):
    """Writes a figure in the format of its ending: .png, .svg or .pdf."""
    from matplotlib import rc_context

    ending = Path(path).suffix.lower()
    # Ids in an SVG are random without a salt.
    with rc_context({"svg.hashsalt": "warpcloth"}), OutputSet() as outputs, outputs.writing(path) as file:
        found = BytesIO()  # after an error of a file, matplotlib raises another, of zlib
        figure.savefig(found, format=ending[1:], dpi=150, facecolor="white", metadata=_METADATA[ending])
        file.write(found.getvalue())
