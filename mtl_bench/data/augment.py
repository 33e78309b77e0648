"""Random changes of one training sample: resize, crop, pad, flip and colour jitter.

N frames of one place (the annotated one and its neighbours) share the geometry and the jitter, and
the intrinsics follow the geometry. Pixel centres are integers: the top-left pixel is (0, 0).
Order and ranges are MGNet's; every side is padded with the same colour, and a flip mirrors the
principal point to W - 1 - cx, as integer centres demand.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from kornia.color import rgb_to_grayscale
from kornia.enhance import adjust_brightness_accumulative, adjust_saturation_with_gray_subtraction
from torch import Generator, Tensor

from mtl_bench import config
from mtl_bench.data.targets import OUTSIDE

PADDING_RGB = (123.675 / 255, 116.28 / 255, 103.53 / 255)  # ImageNet's mean colour

# RGB to luma and two colour differences (NTSC): the plane in which a hue turns
_YIQ = torch.tensor([[0.299, 0.587, 0.114], [0.5959, -0.2746, -0.3213], [0.2115, -0.5227, 0.3112]])


@dataclass
class Augmented:
    clean_N3HW: Tensor  # float RGB in [0, 1]
    jittered_N3HW: Tensor
    K_33: Tensor
    instance_ids_HW: Tensor  # OUTSIDE on padding


def augment(
    frames_N3HW: Tensor,
    K_33: Tensor,
    instance_ids_HW: Tensor,
    settings: config.Augment,
    generator: Generator,
) -> Augmented:
    """One random draw; the result has the crop's size, or the input's where there is no crop.

    Args:
        frames_N3HW: uint8 RGB, the annotated frame first.
        K_33: intrinsics in pixels of the frames.
        instance_ids_HW: Cityscapes' instance ids.
        settings: what may change and how much.
        generator: the only source of randomness.
    """
    scale_draw, top, left, pad_top, pad_left, flip_draw = torch.rand(
        6, generator=generator
    ).tolist()
    height, width = settings.crop or frames_N3HW.shape[-2:]
    factor = settings.scales[int(scale_draw * len(settings.scales))]
    frames, K, ids = resize(frames_N3HW, K_33, instance_ids_HW, factor)

    spare_y, spare_x = frames.shape[-2] - height, frames.shape[-1] - width
    y, x = _offset(top, spare_y), _offset(left, spare_x)
    frames, ids = frames[..., y : y + height, x : x + width], ids[y : y + height, x : x + width]
    K = shift(K, -x, -y)
    if settings.flip and flip_draw < 0.5:
        frames, K, ids = flip(frames, K, ids)

    clean = frames.float() / 255
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
    frames_N3HW: Tensor, K_33: Tensor, ids_HW: Tensor, factor: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Bilinear (averaging where it shrinks), labels by the nearest pixel."""
    height, width = frames_N3HW.shape[-2:]
    size = (round(height * factor), round(width * factor))
    if size == (height, width):
        return frames_N3HW, K_33, ids_HW
    frames = F.interpolate(frames_N3HW, size, mode="bilinear", antialias=True)
    ids = F.interpolate(ids_HW[None, None].float(), size, mode="nearest-exact")[0, 0]
    return frames, scale(K_33, size[1] / width, size[0] / height), ids.to(ids_HW.dtype)


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
    changes = (
        (settings.brightness, adjust_brightness_accumulative),
        (settings.contrast, _adjust_contrast),
        (settings.saturation, adjust_saturation_with_gray_subtraction),
        (settings.hue, _turn_hue),
    )
    for kind in torch.randperm(4, generator=generator).tolist():
        width, change = changes[kind]
        if width > 0:
            picture = change(picture, 1 + width * draws[kind])
    return picture.unflatten(1, (len(frames_N3HW), -1)).transpose(0, 1).contiguous()


def _adjust_contrast(picture_3HW: Tensor, factor: float) -> Tensor:
    """Spread the values about the mean gray: kornia's rule, but row by row, as a mean over a whole
    picture depends on the number of threads in its last bit."""
    mean = rgb_to_grayscale(picture_3HW).mean(-1).mean()
    return (picture_3HW * factor + mean * (1 - factor)).clamp_(0, 1)


def _turn_hue(picture_3HW: Tensor, factor: float) -> Tensor:
    """Turn the hue by (factor - 1) of a full circle at constant luma.

    A rotation of the chroma plane instead of HSV's hexagon, for a thirtieth of the time.
    """
    angle = torch.tensor(2 * torch.pi * (factor - 1), dtype=_YIQ.dtype)
    turn = torch.eye(3)
    turn[1, 1] = turn[2, 2] = angle.cos()
    turn[1, 2], turn[2, 1] = angle.sin(), -angle.sin()
    map_33 = torch.linalg.solve(_YIQ, turn @ _YIQ)
    return (map_33 @ picture_3HW.flatten(1)).clamp_(0, 1).view_as(picture_3HW)
