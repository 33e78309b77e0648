"""Random changes of one training sample: resize, crop, pad, flip and colour jitter.

N frames of one place (the annotated one and its neighbours) share the geometry and the jitter; the
intrinsics and every other field follow the geometry, each by its kind. Pixel centres are integers:
the top-left pixel is (0, 0). Order and ranges are MGNet's; every side is padded with the same
colour, and a flip mirrors the principal point to W - 1 - cx, as integer centres demand.

Frames of 1024 x 2048 set the pace: only what a crop shows is resized, and a worker changes colours
block by block, so that what a block needs stays in the processor's cache.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial

import torch
import torch.nn.functional as F
from kornia.color import rgb_to_grayscale
from kornia.enhance import adjust_brightness_accumulative, adjust_saturation_with_gray_subtraction
from torch import Generator, Tensor

from mtl_bench.core import config
from mtl_bench.core.dataset import Kind
from mtl_bench.core.labels import OUTSIDE

PADDING_RGB = (123.675 / 255, 116.28 / 255, 103.53 / 255)  # ImageNet's mean colour

OUTSIDE_OF = {Kind.IDS: OUTSIDE}  # what padding holds; 0 in other kinds

Change = Callable[[Tensor], Tensor]  # of a block's colours
_BLOCK = 2**16  # pixels of a block; with three channels 768 KiB

# RGB to luma and two colour differences (NTSC): the plane in which a hue turns
_YIQ = torch.tensor([[0.299, 0.587, 0.114], [0.5959, -0.2746, -0.3213], [0.2115, -0.5227, 0.3112]])


@dataclass
class Augmented:
    clean_N3HW: Tensor  # float RGB in [0, 1]
    jittered_N3HW: Tensor
    K_33: Tensor | None
    static_HW: Tensor  # ids, OUTSIDE on padding
    fields: dict[str, Tensor]


def augment(
    frames_N3HW: Tensor | Sequence[Tensor],
    K_33: Tensor | None,
    static_HW: Tensor,
    fields: Mapping[str, Tensor],
    kinds: Mapping[str, Kind],
    settings: config.Augment,
    generator: Generator,
) -> Augmented:
    """One random draw; the result has the crop's size, or the input's where there is no crop.

    Args:
        frames_N3HW: uint8 RGB, the frame itself first; in any memory layout.
        K_33: intrinsics in pixels of the frames; None where there are none.
        static_HW: ids that tell which pixels move with the scene.
        fields: maps of the frame's size and vectors, by name.
        kinds: what each of them is.
        settings: what may change and how much.
        generator: the only source of randomness.
    """
    scale_draw, top, left, pad_top, pad_left, flip_draw = torch.rand(
        6, generator=generator
    ).tolist()
    own = (static_HW.shape[0], static_HW.shape[1])
    height, width = settings.crop or own
    factor = settings.scales[int(scale_draw * len(settings.scales))]
    size = _times(own, factor)
    spare_y, spare_x = size[0] - height, size[1] - width
    y, x = _offset(top, spare_y), _offset(left, spare_x)
    window = (slice(y, min(y + height, size[0])), slice(x, min(x + width, size[1])))
    frames, K = resize(frames_N3HW, K_33, own, factor, window)
    mirrored = settings.flip and flip_draw < 0.5
    if mirrored:
        frames, K = flip(frames, K)

    clean = frames / 255
    jittered = jitter(clean, settings, generator)
    place = None
    if spare_y < 0 or spare_x < 0:  # after the jitter, so that padding has one colour
        y, x = _offset(pad_top, -spare_y), _offset(pad_left, -spare_x)
        place = (slice(y, y + frames.shape[2]), slice(x, x + frames.shape[3]))
        clean = _pad(clean, height, width, place)
        jittered = _pad(jittered, height, width, place)
        K = shift(K, x, y)

    def turned(value: Tensor, kind: Kind) -> Tensor:
        if kind is Kind.VECTOR:
            return value
        value = _nearest_of(value, size, window)
        value = value.flip(-1) if mirrored else value
        if place is not None:
            padded = value.new_full((*value.shape[:-2], height, width), OUTSIDE_OF.get(kind, 0))
            padded[(..., *place)] = value
            value = padded
        return _values(value, kind, factor, mirrored)

    static = turned(static_HW, Kind.IDS)
    own_ids = {name: value is static_HW for name, value in fields.items()}
    made = {
        name: static if own_ids[name] else turned(value, kinds[name])
        for name, value in fields.items()
    }
    return Augmented(clean, jittered, K, static, made)


def _values(value: Tensor, kind: Kind, factor: float, mirrored: bool) -> Tensor:
    """What a zoom and a flip do to the numbers themselves."""
    if kind is Kind.DEPTH and factor != 1:
        return value / factor
    if kind is Kind.INVERSE_DEPTH and factor != 1:
        return value * factor
    if kind is Kind.NORMALS and mirrored:
        return value * value.new_tensor([-1, 1, 1])[:, None, None]
    return value


def _offset(draw: float, spare: int) -> int:
    """A whole offset in 0..spare from a draw in [0, 1); 0 where nothing is spare."""
    return int(draw * (max(spare, 0) + 1))


def _pad(frames: Tensor, height: int, width: int, window: tuple[slice, slice]) -> Tensor:
    padded = frames.new_tensor(PADDING_RGB)[:, None, None].repeat(len(frames), 1, height, width)
    padded[(..., *window)] = frames
    return padded


def resize(
    frames_N3HW: Tensor | Sequence[Tensor],
    K_33: Tensor | None,
    own: tuple[int, int],
    factor: float,
    window: tuple[slice, slice] | None = None,
) -> tuple[Tensor, Tensor | None]:
    """Bilinear, averaging where it shrinks.

    Args:
        own: height and width of the frames.
        window: rows and columns of the resized frames to keep; None: all. What is kept is the same
            to the last bit.
    """
    size = _times(own, factor)
    rows, columns = window or (slice(0, size[0]), slice(0, size[1]))
    K = K_33
    if size == own:
        frames = [frame[:, rows, columns] for frame in frames_N3HW]
    else:
        frames = [_resized(frame, size, rows, columns) for frame in frames_N3HW]
        K = None if K_33 is None else scale(K_33, size[1] / own[1], size[0] / own[0])
    # Channel by channel in memory: the jitter takes the frames for one tall picture.
    return torch.stack(frames, 1).transpose(0, 1), shift(K, -columns.start, -rows.start)


def _nearest_of(value: Tensor, size: tuple[int, int], window: tuple[slice, slice]) -> Tensor:
    """A window of a map at another size, every pixel the nearest of its own."""
    height, width = value.shape[-2:]
    rows, columns = window
    if size == (height, width):
        return value[..., rows, columns]
    down, right = _nearest(height, size[0])[rows], _nearest(width, size[1])[columns]
    return value[..., down, :][..., right]


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


def flip(frames_N3HW: Tensor, K_33: Tensor | None) -> tuple[Tensor, Tensor | None]:
    """Mirror left and right; time still runs forward, so no neighbour changes place."""
    K = K_33
    if K is not None:
        K = K.clone()
        K[0, 2] = frames_N3HW.shape[-1] - 1 - K[0, 2]
    return frames_N3HW.flip(-1), K


def scale(K_33: Tensor, x: float, y: float) -> Tensor:
    """Intrinsics after a resize by these factors: an image starts half a pixel before its first."""
    K = K_33.clone()
    K[0, 0] *= x
    K[1, 1] *= y
    K[0, 2] = (K[0, 2] + 0.5) * x - 0.5
    K[1, 2] = (K[1, 2] + 0.5) * y - 0.5
    return K


def shift(K_33: Tensor | None, x: int, y: int) -> Tensor | None:
    """Intrinsics after every pixel moved right by x and down by y."""
    if K_33 is None:
        return None
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
    found: Tensor = jittered.unflatten(1, (len(frames_N3HW), -1)).transpose(0, 1)
    return found


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
    found: tuple[Tensor, ...] = picture_3HW.split(
        height if torch.get_num_threads() > 1 else max(_BLOCK // width, 1), 1
    )
    return found


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
    found: Tensor = torch.linalg.solve(_YIQ, turn @ _YIQ)
    return found


_CHANGES: tuple[Callable[..., Tensor], ...] = (
    adjust_brightness_accumulative,
    _adjust_contrast,
    adjust_saturation_with_gray_subtraction,
    _turn_hue,
)
_CONTRAST = _CHANGES.index(_adjust_contrast)
