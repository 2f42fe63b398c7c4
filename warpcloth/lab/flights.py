"""Maps of sheets that fly against something thin, over their speed and the step, with the filter of contact and without it."""

from dataclasses import dataclass

import numpy as np

from .panels import Map, point

DISTANCE, DENSITY = 1e-3, 0.15  # r [m], areal density ρ [kg/m²]
STIFFNESS = 10.0 * 9.81 * DENSITY / DISTANCE  # the weight of the sheet compresses a tenth of r [Pa/m]
RATE = np.sqrt(STIFFNESS / DENSITY)  # ω [1/s]
LAWS = {"v h = r": lambda h: DISTANCE / h, "v h = 2r": lambda h: 2.0 * DISTANCE / h}


@dataclass(frozen=True)
class Flights:
    """Names of the axes, values and series of maps of flights.

    Attributes:
        speed: Label of the speed.
        fails: The series of flights that fail; ``holds`` is that of the others.
        failed: Label of the fraction that fails [%], which colours maps without the filter.
        cut: Label of the fraction that was cut short [%], which colours maps with the filter; those that fail are crossed out.
    """

    speed: str
    fails: str
    holds: str
    failed: str
    cut: str

    def panel(self, key, title, laws, filtered):
        """Returns the map of a key and a title; ``laws`` are speeds as functions of the step, by label."""
        return Map(
            key,
            title,
            "step h [s]",
            self.speed,
            scales=("log", "log"),
            laws=laws,
            value=self.cut if filtered else self.failed,
            colours="Blues" if filtered else "Reds",
            crossed=self.fails if filtered else None,
        )

    def points(self, panel, fly, steps, speeds):
        """Returns the points of a map.

        ``fly(h)`` returns the fractions of flights that fail and that were cut short, (S,) each, or raises a ValueError.
        """
        found = []
        for h in steps:
            try:
                failed, cut = fly(h)
            except ValueError as error:
                found += [point(panel.key, "refused", h, None, str(error), y=v) for v in speeds]
                continue
            shares = cut if panel.crossed else failed
            for v, through, share in zip(speeds, failed, shares, strict=True):
                found.append(point(panel.key, self.fails if through > 0.0 else self.holds, h, 100.0 * share, y=v))
        return found


def count_steps(h, speeds):
    """Returns the steps after which the slowest sheet has gone through or turned round."""
    return int(4.0 * DISTANCE / (min(speeds) * h) + 4.0 / (RATE * h)) + 8
