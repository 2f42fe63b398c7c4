"""The numbers that devices of textile laboratories read from a sample at rest.

| Scene | Device | Reading |
|---|---|---|
| cantilever | Shirley tester | overhang at which the tip hangs 41.5° below the clamp, and the bending length (D/ρg)^⅓ |
| loop | hanging heart loop, pear or ring | depth of the loop, and the bending length |
| cusick | Cusick drapemeter | drape coefficient: how much of the ring outside the support has a shadow, seen from above |
| strip | tensile tester | modulus of a strip, force per width over strain |
| picture_frame | picture frame | force along the diagonal, and the shear modulus |

Bending lengths follow from the elastica (:mod:`warpcloth.lab.elastica`), not from Peirce's formula.
"""

from collections.abc import Callable, Sequence

import numpy as np

from ..base.checks import choice
from ..run.equilibrium import Equilibrium
from ..scene.fabric import GRAVITY, Fabric
from ..scene.measured_fabrics import computed_drape
from ..scene.scene import Scene
from ..scenes import cantilever, cusick
from ..terms.plate_bending import PlateBending
from . import elastica

Readings = dict[str, tuple[float, str]]
ANGLE = np.radians(41.5)  # of the Shirley tester
_LINES = 600  # across the shadow of a drape
_ROUNDING = 1e-6  # height of a wave of an outline, relative to its mean radius, below which it is no fold


def laboratory_readings(scene: Scene, rest: Equilibrium) -> Readings:
    """Returns what the device of a scene reads from its sample at rest: (value, unit) by the name of the quantity.

    Args:
        scene: One of the included scenes cantilever, loop, cusick, strip and picture_frame, known by its name.
        rest: Its equilibrium, for strip and picture_frame with ``record="reactions"``.

    Raises:
        ValueError: The scene is none of these, its sample is not held as its device holds it, the reactions were not recorded,
            or the sample hangs too far or too little.

    Examples:
        >>> import warpcloth as wc
        >>> from warpcloth.scenes import strip
        >>> scene = strip.scene("cotton", angle=0.0)
        >>> modulus, unit = wc.laboratory_readings(scene, wc.equilibrium(scene, record="reactions"))["modulus"]
        >>> round(modulus / 2365.0, 2), unit
        (1.0, 'N/m')
    """
    check_sample(scene)
    device, units = DEVICES[scene.name]
    with np.errstate(divide="ignore", invalid="ignore"):
        values = dict(zip(units, map(float, device(scene, rest)), strict=True))
    for quantity, value in values.items():
        if not np.isfinite(value):
            raise ValueError(f"the {quantity} of the scene {scene.name!r} is {value}; a reading must be finite")
    return {quantity: (values[quantity], unit) for quantity, unit in units.items()}


def recorded(device: str, fabric: Fabric, angle: float = 0.0) -> tuple[dict[str, float], str]:
    """Returns readings that follow from the record of a fabric, by name, and why measured ones differ; ``angle`` in rad."""
    if device == "strip":
        return {"modulus": fabric.modulus_along(angle)}, "the reading is at a finite strain"
    if device == "picture_frame":
        return {"shear modulus": fabric.shear}, "iterations end at a tolerance"
    if device == "cusick":
        drape = computed_drape(fabric)
        found = {} if drape is None else {"drape coefficient": drape}
        return found, "the reading is of one start; that of the record is computed too, the mean of eight starts with rows=8"
    D = fabric.bending_along(angle)
    why = "a strip also curves across its width, which makes it softer than the wide cloth of the record"
    if "bending_warp" in fabric.computed:
        why += "; D of the record was not measured but computed, as E·t³/12(1 − ν₁₂ν₂₁)"
    return {"bending length": 1e3 * (D / (fabric.density * GRAVITY)) ** (1 / 3), "D": 1e6 * D}, why


def check_sample(scene: Scene) -> None:
    """Checks that a scene has the name of a test, and a sample that is cut and held as for its device.

    Raises:
        ValueError: It has not.
    """
    choice("scene.name", scene.name, tuple(DEVICES))
    points, held = scene.mesh.points, np.isin(np.arange(len(scene.mesh.points)), scene.pins.vertices)
    x, z, sheet = points[:, 0], points[:, 2], len(scene.mesh.triangles) > 0
    low, high = held[x == x.min()].all(), held[x == x.max()].any()
    if scene.name == "cusick":
        rule = f"a disc of radius {cusick.RADIUS:g} m around the origin, whose boundary further in is pinned"
        radius = np.hypot(x, z)
        good = sheet and np.isclose(radius.max(), cusick.RADIUS)
        good = good and held[scene.mesh.boundary][radius[scene.mesh.boundary] < radius.max() * (1.0 - 1e-9)].all()
    elif scene.name == "picture_frame":
        rule = "a square with a corner at the origin and sides along x and z, whose boundary is pinned"
        good = sheet and held[scene.mesh.boundary].all() and np.isclose(np.ptp(x), np.ptp(z))
        good = good and np.isclose(x.min(), 0.0) and np.isclose(z.min(), 0.0)
    elif scene.name == "cantilever":
        rule, good = "a strip along x, pinned at its lowest x and free at its highest", sheet and low and not high
    else:
        rule, good = "a strip along x, pinned at its lowest and at its highest x", sheet and low and high
    if scene.name in ("cantilever", "loop") and not scene.gravity.any():
        raise ValueError(f"the scene {scene.name!r} has no gravity, which its device needs; its gamma must be above 0")
    if not good:
        raise ValueError(f"the scene {scene.name!r} is not the sample of its device; it must be {rule}")


def drape_coefficient(points: np.ndarray, flat: np.ndarray, triangles: np.ndarray) -> float:
    """Returns the area of the ring outside the support that has a shadow, over that of the flat sample.

    ``points`` and ``flat`` (n, 3) are draped and flat positions [m], with the axis of the support along y through the origin.
    """
    support = np.pi * cusick.SUPPORT**2
    return (_shadow(points, triangles) - support) / (_shadow(flat, triangles) - support)


def _shadow(points, triangles):
    """Returns the area [m²] of the union of triangles and the support, projected along y.

    It is a sum over lines along x by the midpoint rule; the union on each line is exact.
    """
    x, z = np.moveaxis(points[triangles][..., [0, 2]], 2, 0)
    width = 2.0 * np.abs(z).max() / _LINES
    area = 0.0
    for line in width * (np.arange(_LINES) + 0.5 - 0.5 * _LINES):
        crossed = (z.min(axis=1) < line) & (z.max(axis=1) > line)
        a, low = x[crossed], z[crossed]
        b, high = np.roll(a, -1, axis=1), np.roll(low, -1, axis=1)
        between = (low < line) != (high < line)
        at = a + (line - low) / np.where(between, high - low, 1.0) * (b - a)
        half = np.sqrt(max(cusick.SUPPORT**2 - line**2, 0.0))
        begin = np.append(np.where(between, at, np.inf).min(axis=1), -half)
        end = np.append(np.where(between, at, -np.inf).max(axis=1), half)
        order = np.argsort(begin)
        covered = np.maximum.accumulate(end[order])
        new = covered - np.maximum(begin[order], np.append(-np.inf, covered[:-1]))
        area += width * np.maximum(new, 0.0).sum()
    return float(area)


def _clamps(scene):
    """Returns the effective clamp at the low and at the high end of a strip along x [m]: the same if one end is free."""
    held = scene.mesh.points[scene.pins.vertices, 0]
    middle = scene.mesh.points[:, 0].mean()
    found = []
    for side in (held[held < middle], -held[held > middle]):
        if len(side) and any(isinstance(term, PlateBending) for term in scene.terms):
            rows = np.unique(side.round(12))
            if len(rows) < 2:
                raise ValueError(f"an end of the scene {scene.name!r} has one row of pins; a plate must have two to be clamped")
            outer, inner = rows[-2:]
            found.append(inner - cantilever.CLAMP * (inner - outer))
        elif len(side):
            found.append(0.5 * (side.min() + side.max()))
    return found[0], -found[-1]


def _bending(length, gamma, scene):
    bending_length = length * gamma ** (-1 / 3)
    return 1e3 * bending_length, 1e6 * scene.density * np.linalg.norm(scene.gravity) * bending_length**3


def _cantilever(scene, rest):
    flat = scene.mesh.points[:, 0]
    clamp, _ = _clamps(scene)
    spacing = np.unique(flat.round(12))[1] - flat.min()
    narrow = len(np.unique(scene.mesh.points[:, 2].round(12))) == 2  # one row of triangles, of which the end is the mean
    tip = flat > flat.max() - (1.5 if narrow and scene.mesh.grid_shape is None else 0.5) * spacing
    x, y, _ = rest.points[tip].mean(axis=0)
    gamma = elastica.gamma_of(-y / (x - clamp), 1.0, 8.0)
    if gamma is None:
        raise ValueError(
            f"the tip hangs {np.degrees(np.arctan2(-y, x - clamp)):.3g}° below the clamp; its Γ must be from 0.4 to 100, best 8"
        )
    length = flat[tip].mean() - clamp
    device = elastica.gamma_of(np.tan(ANGLE), 1.0, 8.0)
    overhang = 1e3 * length * (device / gamma) ** (1 / 3)
    return np.degrees(np.arctan2(-y, x - clamp)), overhang, *_bending(length, gamma, scene)


def _loop(scene, rest):
    low, high = _clamps(scene)
    length, depth = high - low, -float(rest.points[:, 1].min())
    first, second = rest.points[np.lexsort((scene.mesh.points[:, 0], scene.mesh.points[:, 2]))[:2]]  # ends point that way
    kind = ("pear", "ring", "heart")[1 + round((second - first)[1] / np.linalg.norm(second - first))]
    gamma = elastica.gamma_of_loop(kind, depth / length)
    if gamma is None:
        weightless, deep = elastica.loop_depth(kind, 0.0), f"the {kind} is {depth / length:.4g} of its length deep"
        if depth / length <= weightless:
            raise ValueError(f"{deep}, and without weight it would be {weightless:.4g}; take more elements or a larger Γ")
        raise ValueError(f"{deep}; its Γ must be 200 or less, best 50 to 150")
    return 1e3 * depth, *_bending(length, gamma, scene)


def _cusick(scene, rest):
    points, flat = rest.points, scene.mesh.points
    radius = np.hypot(*flat[:, [0, 2]].T)
    edge = np.flatnonzero(radius > radius.max() * (1.0 - 1e-9))
    outline = np.hypot(*points[edge][:, [0, 2]].T)
    outside = outline > outline.mean() * (1.0 + _ROUNDING)
    return 100.0 * drape_coefficient(points, flat, scene.mesh.triangles), (outside & ~np.roll(outside, 1)).sum()


def _strip(scene, rest):
    x = scene.mesh.points[:, 0]
    pulled = scene.mesh.points[scene.pins.vertices, 0] == x.max()
    width, length = np.ptp(scene.mesh.points[:, 2]), np.ptp(x)
    strain = np.ptp(rest.points[:, 0]) / length - 1.0
    return (_reactions(rest)[pulled, 0].sum() / (width * strain),)


def _picture_frame(scene, rest):
    """By virtual work: the power of the reactions over the rate at which the diagonal becomes longer."""
    flat, held = scene.mesh.points, scene.pins.vertices
    along_x = rest.points[held][np.argmax(flat[held, 0] - flat[held, 2])]
    side, half = np.ptp(flat[:, 0]), float(np.arctan2(along_x[2], along_x[0]))  # γ/2
    c, s = np.cos(half), np.sin(half)
    if not np.allclose(rest.points[held], flat[held] @ [[c, 0.0, s], [0.0, 1.0, 0.0], [s, 0.0, c]], rtol=0.0, atol=1e-5 * side):
        raise ValueError("the pins of the scene 'picture_frame' are not those of a hinged frame; it must turn its sides by γ/2")
    c, s = 0.5 * c, -0.5 * s
    speed = flat[held] @ np.array([[s, 0.0, c], [0.0, 0.0, 0.0], [c, 0.0, s]])  # by γ
    rate = side * np.sin(0.25 * np.pi - half)
    force = (_reactions(rest) * speed).sum() / rate
    return force, force * rate / (side**2 * np.sin(2.0 * half) * np.cos(2.0 * half))


def _reactions(rest):
    if rest.reactions is None:
        raise ValueError('rest has no reactions, which the device measures; find it by equilibrium(scene, record="reactions")')
    return rest.reactions


# By the name of a scene: the function that returns the values of its device, and their units by the names of the quantities.
_STRIP = {"bending length": "mm", "D": "µN·m"}
DEVICES: dict[str, tuple[Callable[[Scene, Equilibrium], Sequence[float]], dict[str, str]]] = {
    "cantilever": (_cantilever, {"angle of the tip": "°", "overhang at 41.5°": "mm", **_STRIP}),
    "loop": (_loop, {"depth of the loop": "mm", **_STRIP}),
    "cusick": (_cusick, {"drape coefficient": "%", "folds": ""}),
    "strip": (_strip, {"modulus": "N/m"}),
    "picture_frame": (_picture_frame, {"force along the diagonal": "N", "shear modulus": "N/m"}),
}
