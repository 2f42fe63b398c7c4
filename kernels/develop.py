"""Pictures from layers of rays: smoothing, and colours in sRGB."""

from functools import cache

import warp as wp

from .render import Layers, Viewer

# Sky visibilities of two points that differ by less may differ only by noise.
SIMILAR = wp.constant(wp.float32(0.08))


@cache
def smooth():
    """Kernel over pixels from ``first`` on: means of ``visible`` over seven pixels of one surface in a row or column, weights
    1, 2, 3, 4, 3, 2, 1.

    Weights decrease with the angle of normals and the distance from the tangent plane. With ``step`` > 1, only similar
    visibility of the sky is smoothed.
    """

    @wp.kernel(module="unique", enable_backward=False)
    def smooth_pixel(
        # state in
        layers: Layers,
        visible: wp.array(dtype=wp.vec2),
        # parameters
        viewer: Viewer,
        vertical: int,
        step: int,
        first: int,
        # out
        out: wp.array(dtype=wp.vec2),
    ):
        pixel = first + wp.tid()
        n = layers.normal[pixel]
        own = visible[pixel]
        if wp.dot(n, n) == 0.0:
            out[pixel] = own
            return
        p = layers.point[pixel]
        # Width of a pixel at that point.
        width = wp.length(p - viewer.origin) * wp.length(viewer.up)
        sky = wp.vec2()  # sum of weights, and sum of weights times visibility
        sun = wp.vec2()
        at = wp.where(vertical != 0, pixel // viewer.width, pixel % viewer.width)
        count = wp.where(vertical != 0, viewer.height, viewer.width)
        stride = wp.where(vertical != 0, viewer.width, 1)
        for k in range(-3, 4):
            if at + step * k >= 0 and at + step * k < count:
                other = pixel + step * k * stride
                turn = wp.dot(n, layers.normal[other])
                if turn > 0.0:
                    off = wp.dot(n, layers.point[other] - p) / width
                    turn = turn * turn
                    turn = turn * turn
                    w = (4.0 - wp.abs(float(k))) * turn * turn / (1.0 + off * off * off * off)
                    seen = visible[other]
                    if seen[0] >= 0.0:
                        change = wp.where(step > 1, (seen[0] - own[0]) / SIMILAR, 0.0)
                        sky += w / (1.0 + change * change * change * change) * wp.vec2(1.0, seen[0])
                    if seen[1] >= 0.0:
                        sun += w * wp.vec2(1.0, seen[1])
        if sky[0] > 0.0:
            own[0] = sky[1] / sky[0]
        if sun[0] > 0.0 and step == 1:
            own[1] = sun[1] / sun[0]
        out[pixel] = own

    return smooth_pixel


@wp.func
def to_srgb(x: float):
    """Linear Rec. 709 to sRGB (IEC 61966-2-1), in 8 bits."""
    x = wp.clamp(x, 0.0, 1.0)
    y = 12.92 * x
    if x > 0.0031308:
        y = 1.055 * wp.pow(x, 1.0 / 2.4) - 0.055
    return wp.uint8(255.0 * y + 0.5)


@cache
def develop():
    """Kernel over pixels: out = the colour in sRGB, in 8 bits."""

    @wp.kernel(module="unique", enable_backward=False)
    def develop_pixel(
        # state in
        layers: Layers,
        # out
        out: wp.array2d(dtype=wp.uint8),
    ):
        pixel = wp.tid()
        seen = layers.visible[pixel]
        colour = layers.base[pixel] + seen[0] * layers.sky[pixel] + seen[1] * layers.sun[pixel]
        for channel in range(3):
            out[pixel, channel] = to_srgb(colour[channel])

    return develop_pixel
