"""From the network's outputs to instances: resizing, grouping, majority vote; see depth_scale too.

Batched tensor code without loops over instances; CPU and CUDA run the same lines.
Shapes: B images, C classes, K centers of the image that has most, N pixels of things, H x W pixels.
Panoptic id: class index * 1000 + instance; instance 0 for stuff, VOID where nothing is predicted.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

from mtl_bench import config
from mtl_bench.data.labels import IGNORE, LabelSet
from mtl_bench.depth_scale import DGC_SOURCES, FAILED, NORMALS, ROAD, dgc_scale
from mtl_bench.model.network import Outputs

__all__ = ["DGC_SOURCES", "FAILED", "NORMALS", "ROAD", "dgc_scale", "find_centers"]
__all__ += ["panoptic", "resize", "to_instance_ids"]

DIVISOR = 1000
VOID = -1
CHUNK = 2**22  # distances held at once: 16 MiB
CPU_CHUNK = 2**17  # what a core's cache holds


def resize(outputs: Outputs, height: int, width: int) -> Outputs:
    """Outputs at another size: bilinear, corners not aligned, depth as inverse depth.

    Offsets are pixels, so they are scaled as well (MGNet's public code leaves them).
    """

    def to(x: Tensor) -> Tensor:
        return F.interpolate(x.float(), (height, width), mode="bilinear", align_corners=False)

    semantic, center, offset = outputs.semantic_BCHW, outputs.center_B1HW, outputs.offset_B2HW
    if offset is not None:
        rows, columns = offset.shape[2:]
        factor = offset.new_tensor([height / rows, width / columns]).view(1, 2, 1, 1)
        offset = to(offset) * factor
    return Outputs(
        semantic_BCHW=None if semantic is None else to(semantic),
        center_B1HW=None if center is None else to(center),
        offset_B2HW=offset,
        inverse_depth=[to(inverse) for inverse in outputs.inverse_depth],
    )


# --- instances ------------------------------------------------------------------------------------


def panoptic(
    semantic: Tensor,
    center_B1HW: Tensor,
    offset_B2HW: Tensor,
    things: tuple[int, ...],
    ev: config.Evaluate,
) -> Tensor:
    """Panoptic ids [B,H,W], int64: every thing pixel joins the center that it points nearest to.

    Panoptic-DeepLab's grouping (Cheng et al., CVPR 2020) with MGNet's numbering: centers count from
    1 in reading order over all classes, and an instance takes the class that most of its pixels
    have (ties: the lowest). Ties of distance go to the first center. In an image without a center,
    thing pixels keep instance 0. Stuff classes of fewer than `ev.stuff_area` pixels become void.

    Args:
        semantic: logits [B,C,H,W] or class indices [B,H,W] (IGNORE becomes void).
        center_B1HW: heat map.
        offset_B2HW: (y, x) from each pixel to its center, pixels.
        things: class indices.
        ev: `center_threshold` (strict), `nms_kernel`, `top_k` and `stuff_area` are used.
    """
    class_BHW = semantic.argmax(1) if semantic.dim() == 4 else semantic.long()
    centers_BK2, count_B = find_centers(center_B1HW, ev)
    result_BHW = class_BHW * DIVISOR
    result_BHW = _drop_small_stuff(result_BHW, class_BHW, things, ev.stuff_area)

    is_thing_BHW = _member(class_BHW, things)
    image_N, y_N, x_N = (is_thing_BHW & (count_B > 0)[:, None, None]).nonzero(as_tuple=True)
    if len(image_N) == 0:
        return result_BHW
    offset_2N = offset_B2HW.float()[image_N, :, y_N, x_N].T
    target_N2 = torch.stack([y_N + offset_2N[0], x_N + offset_2N[1]], 1)
    nearest_N = _nearest(target_N2, image_N, centers_BK2)

    # One vote per pixel: a table instance x class, filled by a single count
    order = torch.tensor(sorted(things), device=class_BHW.device)
    vote_N = torch.searchsorted(order, class_BHW[image_N, y_N, x_N])
    instance_N = image_N * centers_BK2.shape[1] + nearest_N
    cells = centers_BK2.shape[0] * centers_BK2.shape[1] * len(order)
    votes = torch.bincount(instance_N * len(order) + vote_N, minlength=cells).view(-1, len(order))
    winner_N = order[votes.argmax(1)][instance_N]
    result_BHW[image_N, y_N, x_N] = winner_N * DIVISOR + nearest_N + 1
    return result_BHW


def find_centers(center_B1HW: Tensor, ev: config.Evaluate) -> tuple[Tensor, Tensor]:
    """Local maxima above the threshold: (y, x) [B,K,2], filled up with inf; counts [B].

    In reading order. Where there are more than `ev.top_k`, the highest stay; of equals, the first.
    Equal neighbours are both centers: of two true instances closer than the kernel neither is lost.
    """
    kernel = ev.nms_kernel
    if kernel % 2 == 0:
        raise ValueError(f"evaluate.nms_kernel must be odd, not {kernel}")
    heat_B1HW = center_B1HW.float()
    is_peak_B1HW = (heat_B1HW == _highest(heat_B1HW, kernel)) & (heat_B1HW > ev.center_threshold)
    image_P, _, y_P, x_P = is_peak_B1HW.nonzero(as_tuple=True)

    images = heat_B1HW.shape[0]
    found_B = torch.bincount(image_P, minlength=images)
    first_B = found_B.cumsum(0) - found_B
    by_height = heat_B1HW[image_P, 0, y_P, x_P].sort(descending=True, stable=True).indices
    by_image = by_height[image_P[by_height].sort(stable=True).indices]
    place_P = torch.arange(len(image_P), device=image_P.device)
    rank_P = torch.empty_like(place_P).scatter_(0, by_image, place_P - first_B[image_P])
    kept_P = rank_P < ev.top_k
    image_P, y_P, x_P = image_P[kept_P], y_P[kept_P], x_P[kept_P]

    count_B = torch.bincount(image_P, minlength=images)
    number_P = torch.arange(len(image_P), device=image_P.device)
    number_P = number_P - (count_B.cumsum(0) - count_B)[image_P]
    centers_BK2 = heat_B1HW.new_full((images, int(count_B.max()), 2), torch.inf)
    centers_BK2[image_P, number_P] = torch.stack([y_P, x_P], 1).to(centers_BK2)
    return centers_BK2, count_B


def to_instance_ids(panoptic_BHW: Tensor, labels: LabelSet) -> Tensor:
    """Cityscapes' ids, int32: label id, or label id * 1000 + instance; 0 for what is not evaluated.

    A thing pixel without an instance keeps its bare label id: one segment of its class.
    """
    table = [label.label_id if label.evaluated else 0 for label in labels.labels]
    label_of_class = torch.tensor([*table, 0], device=panoptic_BHW.device)
    instance_BHW = panoptic_BHW % DIVISOR
    index_BHW = torch.where(panoptic_BHW == VOID, len(labels), panoptic_BHW // DIVISOR)
    label_BHW = label_of_class[index_BHW]
    numbered_BHW = (instance_BHW > 0) & (label_BHW > 0)
    return torch.where(numbered_BHW, label_BHW * DIVISOR + instance_BHW, label_BHW).int()


def _highest(x_B1HW: Tensor, kernel: int) -> Tensor:
    """Maximum of the window around each pixel: of its rows, then of those."""
    rows_B1HW = F.max_pool2d(x_B1HW, (1, kernel), stride=1, padding=(0, kernel // 2))
    return F.max_pool2d(rows_B1HW, (kernel, 1), stride=1, padding=(kernel // 2, 0))


def _nearest(target_N2: Tensor, image_N: Tensor, centers_BK2: Tensor) -> Tensor:
    """Index [N] of the nearest center of the pixel's image; pixels come image by image."""
    chunk = CPU_CHUNK if target_N2.device.type == "cpu" else CHUNK
    size = max(chunk // centers_BK2.shape[1], 1)
    pixels = torch.bincount(image_N, minlength=len(centers_BK2)).tolist()
    parts = []
    for target_P2, center_K2 in zip(target_N2.split(pixels), centers_BK2, strict=True):
        for target_p2 in target_P2.split(size):
            distance_pK = (target_p2[:, :1] - center_K2[:, 0]).square_()
            distance_pK += (target_p2[:, 1:] - center_K2[:, 1]).square_()
            parts.append(distance_pK.argmin(1))
    return torch.cat(parts)


def _member(class_BHW: Tensor, classes: tuple[int, ...]) -> Tensor:
    table = torch.zeros(IGNORE + 1, dtype=torch.bool, device=class_BHW.device)
    table[list(classes)] = True
    return table[class_BHW]


def _drop_small_stuff(
    result_BHW: Tensor, class_BHW: Tensor, things: tuple[int, ...], least: int
) -> Tensor:
    """Void where there is no class, and where a stuff class covers too little of its image."""
    images = torch.arange(len(class_BHW), device=class_BHW.device)[:, None, None]
    row_BHW = images * (IGNORE + 1) + class_BHW
    area = torch.bincount(row_BHW.flatten(), minlength=len(class_BHW) * (IGNORE + 1))
    drop = (area < least).view(len(class_BHW), IGNORE + 1)
    drop[:, list(things)] = False
    drop[:, IGNORE] = True
    return result_BHW.masked_fill(drop.flatten()[row_BHW], VOID)
