"""Random changes of one training sample: resize, crop, pad, flip and colour jitter.

N frames of one place (the annotated one and its neighbours) share the geometry and the jitter, and
the intrinsics follow the geometry. Pixel centres are integers: the top-left pixel is (0, 0).
Order and ranges are MGNet's; every side is padded with the same colour, and a flip mirrors the
principal point to W - 1 - cx, as integer centres demand.

Frames of 1024 x 2048 set the pace: only what a crop shows is resized, and a worker changes colours
block by block, so that what a block needs stays in the processor's cache.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial

import torch
import torch.nn.functional as F
from kornia.color import rgb_to_grayscale
from kornia.enhance import adjust_brightness_accumulative, adjust_saturation_with_gray_subtraction
from torch import Generator, Tensor

from mtl_bench.core import config
from mtl_bench.tasks.panoptic.targets import OUTSIDE

PADDING_RGB = (123.675 / 255, 116.28 / 255, 103.53 / 255)  # ImageNet's mean colour

Change = Callable[[Tensor], Tensor]  # of a block's colours
_BLOCK = 2**16  # pixels of a block; with three channels 768 KiB

# RGB to luma and two colour differences (NTSC): the plane in which a hue turns
_YIQ = torch.tensor([[0.299, 0.587, 0.114], [0.5959, -0.2746, -0.3213], [0.2115, -0.5227, 0.3112]])


@dataclass
class Augmented:
    clean_N3HW: Tensor  # float RGB in [0, 1]
    jittered_N3HW: Tensor
    K_33: Tensor
    instance_ids_HW: Tensor  # OUTSIDE on padding


def augment(
    frames_N3HW: Tensor | Sequence[Tensor],
    K_33: Tensor,
    instance_ids_HW: Tensor,
    settings: config.Augment,
    generator: Generator,
) -> Augmented:
    """One random draw; the result has the crop's size, or the input's where there is no crop.

    Args:
        frames_N3HW: uint8 RGB, the annotated frame first; in any memory layout.
        K_33: intrinsics in pixels of the frames.
        instance_ids_HW: Cityscapes' instance ids.
        settings: what may change and how much.
        generator: the only source of randomness.
    """
    scale_draw, top, left, pad_top, pad_left, flip_draw = torch.rand(
        6, generator=generator
    ).tolist()
    height, width = settings.crop or instance_ids_HW.shape
    factor = settings.scales[int(scale_draw * len(settings.scales))]
    size = _times(instance_ids_HW.shape, factor)
    spare_y, spare_x = size[0] - height, size[1] - width
    y, x = _offset(top, spare_y), _offset(left, spare_x)
    window = (slice(y, min(y + height, size[0])), slice(x, min(x + width, size[1])))
    frames, K, ids = resize(frames_N3HW, K_33, instance_ids_HW, factor, window)
    if settings.flip and flip_draw < 0.5:
        frames, K, ids = flip(frames, K, ids)

    clean = frames / 255
    jittered = jitter(clean, settings, generator)
    if spare_y < 0 or spare_x < 0:  # after the jitter, so that padding has one colour
        y, x = _offset(pad_top, -spare_y), _offset(pad_left, -spare_x)
        window = (slice(y, y + ids.shape[0]), slice(x, x + ids.shape[1]))
        clean = _pad(clean, height, width, window)
        jittered = _pad(jittered, height, width, window)
        ids, inner = ids.new_full((height, width), OUTSIDE), ids
        ids[window] = inner
        K = shift(K, x, y)
    return Augmented(clean, jittered, K, ids)


def _offset(draw: float, spare: int) -> int:
    """A whole offset in 0..spare from a draw in [0, 1); 0 where nothing is spare."""
    return int(draw * (max(spare, 0) + 1))


def _pad(frames: Tensor, height: int, width: int, window: tuple[slice, slice]) -> Tensor:
    padded = frames.new_tensor(PADDING_RGB)[:, None, None].repeat(len(frames), 1, height, width)
    padded[(..., *window)] = frames
    return padded


def resize(
    frames_N3HW: Tensor | Sequence[Tensor],
    K_33: Tensor,
    ids_HW: Tensor,
    factor: float,
    window: tuple[slice, slice] | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Bilinear (averaging where it shrinks), labels by the nearest pixel.

    Args:
        window: rows and columns of the resized frames to keep; None: all. What is kept is the same
            to the last bit.
    """
    height, width = ids_HW.shape
    size = _times(ids_HW.shape, factor)
    rows, columns = window or (slice(0, size[0]), slice(0, size[1]))
    if size == (height, width):
        frames, K, ids = [frame[:, rows, columns] for frame in frames_N3HW], K_33, ids_HW
        ids = ids_HW[rows, columns]
    else:
        frames = [_resized(frame, size, rows, columns) for frame in frames_N3HW]
        K = scale(K_33, size[1] / width, size[0] / height)
        ids = ids_HW[_nearest(height, size[0])[rows]][:, _nearest(width, size[1])[columns]]
    # Channel by channel in memory: the jitter takes the frames for one tall picture.
    return torch.stack(frames, 1).transpose(0, 1), shift(K, -columns.start, -rows.start), ids


def _times(size: Sequence[int], factor: float) -> tuple[int, int]:
    return round(size[0] * factor), round(size[1] * factor)


def _resized(frame_3HW: Tensor, size: tuple[int, int], rows: slice, columns: slice) -> Tensor:
    """The window of a resized frame. Torch goes along the rows, then along the columns, and so does
    this, but first only through the rows that the window is made of, then only through its columns.
    """
    height = frame_3HW.shape[-2]
    step = height / size[0]
    reach = max(step, 1.0) + 1  # source pixels to either side that a pixel may be made of
    first = max(math.floor((rows.start + 0.5) * step - reach), 0)
    last = min(math.ceil((rows.stop - 0.5) * step + reach), height)
    if (first, last) == (0, height) and columns == slice(0, size[1]):
        return _bilinear(frame_3HW[None], size)[0, :, rows]
    wide = _bilinear(frame_3HW[None, :, first:last], (last - first, size[1]))[..., columns]
    shape = (1, 3, height, wide.shape[-1])
    tall = torch.empty(shape, dtype=torch.uint8, memory_format=torch.channels_last)
    tall[..., first:last, :] = wide  # the other rows are read for pixels outside the window alone
    return _bilinear(tall, (size[0], wide.shape[-1]))[0, :, rows]


def _bilinear(image_13HW: Tensor, size: tuple[int, int]) -> Tensor:
    return F.interpolate(image_13HW, size, mode="bilinear", antialias=True)


def _nearest(old: int, new: int) -> Tensor:
    """[new] which of `old` pixels a pixel becomes."""
    pixels = torch.arange(old, dtype=torch.float32)[None, None]
    return F.interpolate(pixels, new, mode="nearest-exact")[0, 0].long()


def flip(frames_N3HW: Tensor, K_33: Tensor, ids_HW: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Mirror left and right; time still runs forward, so no neighbour changes place."""
    K = K_33.clone()
    K[0, 2] = frames_N3HW.shape[-1] - 1 - K[0, 2]
    return frames_N3HW.flip(-1), K, ids_HW.flip(-1)


def scale(K_33: Tensor, x: float, y: float) -> Tensor:
    """Intrinsics after a resize by these factors: an image starts half a pixel before its first."""
    K = K_33.clone()
    K[0, 0] *= x
    K[1, 1] *= y
    K[0, 2] = (K[0, 2] + 0.5) * x - 0.5
    K[1, 2] = (K[1, 2] + 0.5) * y - 0.5
    return K


def shift(K_33: Tensor, x: int, y: int) -> Tensor:
    """Intrinsics after every pixel moved right by x and down by y."""
    K = K_33.clone()
    K[0, 2] += x
    K[1, 2] += y
    return K


def jitter(frames_N3HW: Tensor, settings: config.Augment, generator: Generator) -> Tensor:
    """Brightness, contrast, saturation and hue in random order: one colour map for all frames.

    Args:
        frames_N3HW: float RGB in [0, 1].
        settings: half-widths; factors are drawn from 1 +- width, the hue's turn from +- width.
        generator: the source of randomness.
    """
    # Below one another as one picture: contrast then pivots on one mean, not on one a frame.
    picture = frames_N3HW.transpose(0, 1).flatten(1, 2)
    draws = (torch.rand(4, generator=generator) * 2 - 1).tolist()
    widths = (settings.brightness, settings.contrast, settings.saturation, settings.hue)
    order = [kind for kind in torch.randperm(4, generator=generator).tolist() if widths[kind] > 0]
    changes = [partial(_CHANGES[kind], factor=1 + widths[kind] * draws[kind]) for kind in order]
    jittered = torch.empty_like(picture)
    if _CONTRAST in order:
        at = order.index(_CONTRAST)
        _apply(changes[:at], picture, jittered)
        adjust = partial(changes[at], mean=_mean_gray(jittered))
        _apply([adjust, *changes[at + 1 :]], jittered, jittered)
    else:
        _apply(changes, picture, jittered)
    return jittered.unflatten(1, (len(frames_N3HW), -1)).transpose(0, 1)


def _apply(changes: Sequence[Change], source_3HW: Tensor, target_3HW: Tensor) -> None:
    """Write the changed source into the target, which may be the source itself."""
    for block, place in zip(_blocks(source_3HW), _blocks(target_3HW), strict=True):
        for change in changes:
            block = change(block)
        place.copy_(block)


def _blocks(picture_3HW: Tensor) -> tuple[Tensor, ...]:
    """Bands of rows. Several threads get the whole picture, which they share out by themselves: in
    every block they would wait for one another, for seconds where the machine is busy."""
    height, width = picture_3HW.shape[1:]
    return picture_3HW.split(height if torch.get_num_threads() > 1 else max(_BLOCK // width, 1), 1)


def _mean_gray(picture_3HW: Tensor) -> Tensor:
    """Row by row: a mean over a whole picture depends on the number of threads in its last bit."""
    rows = [rgb_to_grayscale(block).mean(-1) for block in _blocks(picture_3HW)]
    return torch.cat(rows, 1).mean()


def _adjust_contrast(picture_3HW: Tensor, factor: float, mean: Tensor) -> Tensor:
    """Spread the values about the mean gray: kornia's rule."""
    return (picture_3HW * factor + mean * (1 - factor)).clamp_(0, 1)


def _turn_hue(picture_3HW: Tensor, factor: float) -> Tensor:
    """Turn the hue by (factor - 1) of a full circle at constant luma.

    A rotation of the chroma plane instead of HSV's hexagon, for a thirtieth of the time.
    """
    return (_hue_map(factor) @ picture_3HW.flatten(1)).clamp_(0, 1).view_as(picture_3HW)


@lru_cache(maxsize=1)  # all blocks of a picture have one
def _hue_map(factor: float) -> Tensor:
    angle = torch.tensor(2 * torch.pi * (factor - 1), dtype=_YIQ.dtype)
    turn = torch.eye(3)
    turn[1, 1] = turn[2, 2] = angle.cos()
    turn[1, 2], turn[2, 1] = angle.sin(), -angle.sin()
    return torch.linalg.solve(_YIQ, turn @ _YIQ)


_CHANGES: tuple[Callable[..., Tensor], ...] = (
    adjust_brightness_accumulative,
    _adjust_contrast,
    adjust_saturation_with_gray_subtraction,
    _turn_hue,
)
_CONTRAST = _CHANGES.index(_adjust_contrast)
