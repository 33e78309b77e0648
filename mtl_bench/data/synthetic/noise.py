"""Solid noise and box-filtered patterns: textures that neither swim nor alias.

Both are functions of a point fixed to the object, so every view of a surface sees the same texture,
and both take the pixel's footprint (metres on the surface) and blur themselves to it.
"""

import numpy as np
from numpy.typing import NDArray

from mtl_bench.data.synthetic.camera import FloatArray

WAVELENGTHS_M = (17.0, 6.4, 2.3, 0.85, 0.32, 0.12, 0.045)
_PERIOD = 32  # lattice cells until the noise repeats
_BITS = 5


def _lattice() -> FloatArray:
    """[32^3,8] values in [-1,1] at the corners of every cell; one fixed table for all scenes."""
    values = np.random.default_rng(0).uniform(-1, 1, (_PERIOD,) * 3).astype(np.float32)
    shifts = [(i, j, k) for i in (0, -1) for j in (0, -1) for k in (0, -1)]
    return np.stack([np.roll(values, s, (0, 1, 2)).ravel() for s in shifts], 1)


_CORNERS = _lattice()


def lattice_noise(points_N3: FloatArray) -> FloatArray:
    """Smooth noise [N] of unit wavelength, about [-1,1]."""
    cell = np.floor(points_N3)
    f = points_N3 - cell
    f = f * f * (3 - 2 * f)
    i = cell.astype(np.int32) & (_PERIOD - 1)
    c = _CORNERS[(i[:, 0] << 2 * _BITS) | (i[:, 1] << _BITS) | i[:, 2]]
    c = c[:, :4] + (c[:, 4:] - c[:, :4]) * f[:, 0, None]
    c = c[:, :2] + (c[:, 2:] - c[:, :2]) * f[:, 1, None]
    return c[:, 0] + (c[:, 1] - c[:, 0]) * f[:, 2]


def fractal_noise(
    points_N3: FloatArray, amplitude_NK: FloatArray, footprint_N: FloatArray
) -> FloatArray:
    """Sum of octaves [N]; an octave fades out while its wavelength shrinks from 9 to 3 pixels."""
    total = np.zeros(len(points_N3), np.float32)
    for k, wavelength in enumerate(WAVELENGTHS_M):
        weight = amplitude_NK[:, k] * np.clip(np.log2(wavelength / (3 * footprint_N)) / 1.6, 0, 1)
        seen = np.flatnonzero(weight)
        if len(seen):
            shifted = points_N3[seen] * np.float32(1 / wavelength) + np.float32(7.31 * k)
            total[seen] += weight[seen] * lattice_noise(shifted)
    return total


def pulses(x: FloatArray, duty: FloatArray | float, width: FloatArray) -> FloatArray:
    """Coverage of a pulse train (1 on [0, duty), 0 on [duty, 1)) seen through a box of `width`."""
    width = np.maximum(width, 1e-3)

    def area(x: FloatArray) -> FloatArray:
        whole = np.floor(x)
        return whole * duty + np.minimum(x - whole, duty)

    return (area(x + width / 2) - area(x - width / 2)) / width


def band(
    x: FloatArray, low: FloatArray | float, high: FloatArray | float, width: FloatArray
) -> FloatArray:
    """Coverage of the interval [low, high] with edges that rise smoothly over 1.8 `width`."""
    width = np.maximum(1.8 * width, 1e-4)

    def edge(t: FloatArray) -> FloatArray:
        t = np.clip(t + 0.5, 0, 1)
        return t * t * (3 - 2 * t)

    return edge((x - low) / width) - edge((x - high) / width)


def mix(a: FloatArray, b: FloatArray, share_N: FloatArray) -> FloatArray:
    """Colours a [.,3] where the share is 0, b where it is 1."""
    return a + (b - a) * share_N[:, None]


def cell_random(a: NDArray, b: NDArray) -> FloatArray:
    """A number in [0,1) for every integer pair: which window is lit."""
    h = (a.astype(np.int64) * 73856093) ^ (b.astype(np.int64) * 19349663)
    return (((h * 2654435761) >> 8) & 1023).astype(np.float32) / 1024
