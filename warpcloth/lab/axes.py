"""Axes of maps of stability, and default values of axes that a map does not have."""

from dataclasses import dataclass

import numpy as np

from ..base.checks import number, whole

SEED = 0


@dataclass(frozen=True)
class Axis:
    """One axis of a map, with its default range; values may be ``whole`` numbers, or spaced logarithmically."""

    label: str
    low: float
    high: float
    whole: bool = False
    logarithmic: bool = True

    def values(self, low, high, count):
        """Returns ``count`` values; fewer if whole numbers coincide.

        Raises:
            ValueError: The range is not allowed on this axis.
        """
        whole("count", count, 1)
        number("low", low, **({"above": 0.0} if self.logarithmic else {}))
        number("high", high, least=low)
        spaced = (np.geomspace if self.logarithmic else np.linspace)(low, high, count)
        return (
            list(dict.fromkeys(round(float(value)) for value in spaced)) if self.whole else [float(f"{v:.6g}") for v in spaced]
        )


AXES = {
    "dt": Axis("step h [s]", 1e-4, 1e-1),
    "stiffness": Axis("stiffness, times the scene's", 1e-2, 1e4),
    "resolution": Axis("resolution", 4, 24, whole=True),
    "iterations": Axis("iterations a step", 1, 100, whole=True),
    "relaxation": Axis("relaxation ω", 0.1, 4.0),
    "weight": Axis("weight r = W²/(kA)", 1e-3, 1e3),
    "mass-ratio": Axis("mass of the vertex furthest from the pins, times the scene's", 1e-2, 1e4),
    "compression": Axis("initial compression, 1 − l/L", 0.0, 0.9, logarithmic=False),
}
# Axes along which copies of one model can differ, so that a row is one run.
VARIED = ("stiffness", "mass-ratio", "compression")
OPTIONS = ("iterations", "relaxation", "weight")
# Values of axes that a map does not have.
FIXED = {"dt": 1 / 60}
# A run is inaccurate if its RMS distance to the reference, over the size of the cloth, exceeds this.
ACCURACY = 0.01
