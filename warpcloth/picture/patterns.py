"""Fixed, even sampling patterns."""

import numpy as np


def pixel_samples(count):
    """Returns positions (count, 2) in a pixel, from 0 to 1, even in each direction.

    Four are a square rotated by atan ½; others the lattice (k + ½, gk + ½)/count with the g of the largest smallest distance.
    """
    if count == 4:
        return np.array([(0.125, 0.625), (0.375, 0.125), (0.625, 0.875), (0.875, 0.375)])
    k = np.arange(count)

    def gap(g):
        apart = np.stack([k[1:], g * k[1:] % count])
        return (np.minimum(apart, count - apart) ** 2).sum(axis=0).min(initial=2 * count**2)

    best = max((g for g in range(1, count + 1) if np.gcd(g, count) == 1), key=gap)
    return np.stack([k + 0.5, best * k % count + 0.5], axis=1) / count


def disc(count):
    """Returns points (count, 2) of a low-discrepancy sequence in the unit disc.

    Multiples of 1/g and 1/g² modulo 1, g³ = g + 1 (Roberts 2018), are squared radii and angles.
    """
    g = 1.3247179572447460
    squared, turn = np.modf(0.5 + np.arange(count)[:, None] / [g, g**2])[0].T
    angle = 2.0 * np.pi * turn
    return np.sqrt(squared)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
