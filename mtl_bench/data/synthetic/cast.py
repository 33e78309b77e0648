"""Which solid every ray hits first, and at what depth.

Solids with a large image box are tested one by one on that box, as broadcast rows and columns; the
many small ones (wheels, legs, far things) together, as one flat list of (solid, ray) pairs.
"""

import numpy as np
from numpy.typing import NDArray

from mtl_bench.data.synthetic.camera import Camera, FloatArray, Pose
from mtl_bench.data.synthetic.primitives import (
    BOX,
    ELLIPSOID,
    Solids,
    hit,
    screen_bounds,
    unit_frames,
)

_SMALL = 600  # rays; up to here the cost of a call outweighs that of the pairs


def cast(
    solids: Solids, camera: Camera, pose: Pose, time: int, u_W: FloatArray, v_H: FloatArray
) -> tuple[FloatArray, NDArray[np.int32]]:
    """Cast the rays of the pixel columns u_W and rows v_H (any fractions, evenly spaced, rising).

    Returns depth [H,W] in metres (inf = sky) and the index of the solid hit (-1 = sky).
    """
    directions, origins = unit_frames(solids, pose, time)
    bounds, nearest = screen_bounds(solids, pose, camera, time)
    c0, c1 = _range(bounds[:, 0], bounds[:, 1], u_W)
    r0, r1 = _range(bounds[:, 2], bounds[:, 3], v_H)
    area = np.maximum(c1 - c0, 0) * np.maximum(r1 - r0, 0)
    x = ((u_W - camera.u0) / camera.fx).astype(np.float32)
    y = ((v_H - camera.v0) / camera.fy).astype(np.float32)
    depth = np.full((len(v_H), len(u_W)), np.inf, np.float32)
    index = np.full(depth.shape, -1, np.int32)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        for i in np.flatnonzero(area > _SMALL)[np.argsort(nearest[area > _SMALL], kind="stable")]:
            window = slice(r0[i], r1[i]), slice(c0[i], c1[i])
            xs, ys = x[None, window[1]], y[window[0], None]
            d = tuple(m[0] * xs + (m[1] * ys + m[2]) for m in directions[i])
            t = hit(solids.kind_P[i], tuple(origins[i]), d, tuple(solids.taper_P3[i]))
            better = t < depth[window]
            depth[window][better] = t[better]
            index[window][better] = i
        for kind in range(BOX, ELLIPSOID + 1):
            few = np.flatnonzero((area > 0) & (area <= _SMALL) & (solids.kind_P == kind))
            if len(few):
                solid, row, col = _pairs(few, r0[few], c0[few], c1[few] - c0[few], area[few])
                m, xs, ys = directions[solid], x[col], y[row]
                d = tuple(m[:, j, 0] * xs + (m[:, j, 1] * ys + m[:, j, 2]) for j in range(3))
                t = hit(kind, tuple(origins[solid].T), d, tuple(solids.taper_P3[solid].T))
                _nearest(depth, index, solid, row * len(u_W) + col, t)
    return depth, index


def _range(low: FloatArray, high: FloatArray, samples: FloatArray) -> tuple[NDArray, NDArray]:
    """First and one-past-last sample inside [low, high], a little widened against rounding."""
    step = float(samples[1] - samples[0]) if len(samples) > 1 else 1.0
    limit = len(samples)
    first = np.clip(np.ceil((low - samples[0]) / step - 0.01), 0, limit)
    last = np.clip(np.floor((high - samples[0]) / step + 0.01) + 1, 0, limit)
    return first.astype(np.int64), last.astype(np.int64)


def _pairs(solids: NDArray, r0: NDArray, c0: NDArray, wide: NDArray, area: NDArray):
    """All (solid, row, column) of image boxes given by corner, width and area, as flat arrays."""
    which = np.repeat(np.arange(len(solids)), area)
    within = np.arange(len(which)) - np.repeat(np.cumsum(area) - area, area)
    row, col = np.divmod(within, wide[which])
    return solids[which], row + r0[which], col + c0[which]


def _nearest(
    depth: FloatArray, index: NDArray, solid: NDArray, ray: NDArray, t: FloatArray
) -> None:
    """Put the nearest of several hits of a ray into the flat views of depth and index."""
    flat_depth, flat_index = depth.reshape(-1), index.reshape(-1)
    better = np.flatnonzero(t < flat_depth[ray])
    order = better[np.argsort(-t[better], kind="stable")]  # of equal indices the last one stays
    flat_depth[ray[order]] = t[order]
    flat_index[ray[order]] = solid[order]
