"""From maps to instances: centers, grouping, majority vote.

Batched tensor code without loops over instances or images; CPU, CUDA and exported graphs run the
same lines. Gathers are `index_select`: on the CPU several times faster than `x[i]`.
Shapes: B images, C classes, K centers of the image that has most, N pixels of things, P peaks,
T classes of things, H x W pixels.
Panoptic id: class index * 1000 + instance; instance 0 for stuff, VOID where nothing is predicted.
"""

import torch
from torch import Tensor

from mtl_bench.core import config
from mtl_bench.core.labels import DIVISOR, IGNORE, LabelSet
from mtl_bench.tasks import pixels
from mtl_bench.tasks.panoptic.nearest_center import nearest

VOID = -1


def panoptic(
    semantic: Tensor,
    center_B1HW: Tensor,
    offset_B2HW: Tensor,
    things: tuple[int, ...],
    ev: config.Evaluate,
) -> Tensor:
    """Panoptic ids [B,H,W], int32: every thing pixel joins the center that it points nearest to.

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
    class_BHW = classes(semantic)
    centers_BK2, count_B = find_centers(center_B1HW, ev)
    return group(class_BHW, centers_BK2, count_B, offset_B2HW, things, ev.stuff_area)


def classes(semantic: Tensor) -> Tensor:
    """Class indices [B,H,W] of logits or classes, in few bytes: time is what memory takes.

    uint8; int32 in an exported graph, since ONNX Runtime compares no uint8.
    """
    class_BHW = semantic.argmax(1) if semantic.dim() == 4 else semantic
    return class_BHW.to(torch.int32 if torch.compiler.is_exporting() else torch.uint8)


def find_centers(center_B1HW: Tensor, ev: config.Evaluate) -> tuple[Tensor, Tensor]:
    """Local maxima above the threshold: (y, x) [B,K,2], filled up with inf; counts [B].

    In reading order. Where there are more than `ev.top_k`, the highest stay; of equals, the first.
    Equal neighbours are both centers: of two true instances closer than the kernel neither is lost.
    K is the most that an image has, at least 1; in an exported graph it is `ev.top_k`.
    """
    heat_B1HW = center_B1HW.float()
    images, _, height, width = heat_B1HW.shape
    pixel_P = pixels.where(pixels.peaks(heat_B1HW, ev.nms_kernel, ev.center_threshold))
    height_P = heat_B1HW.flatten().index_select(0, pixel_P)
    in_image_BP = (
        pixel_P // (height * width) == torch.arange(images, device=pixel_P.device)[:, None]
    )
    height_BP = torch.where(in_image_BP, height_P, -torch.inf)

    # Sorting with equals in order cannot be exported: the lowest height that stays, then the first
    padded = torch.cat([height_BP, height_BP.new_full((images, ev.top_k), -torch.inf)], 1)
    least_B1 = padded.topk(ev.top_k, 1).values[:, -1:]
    higher_BP, equal_BP = height_BP > least_B1, in_image_BP & (height_BP == least_B1)
    room_B1 = ev.top_k - higher_BP.sum(1, keepdim=True)
    kept_BP = higher_BP | (equal_BP & (equal_BP.cumsum(1) <= room_B1))
    count_B = kept_BP.sum(1)

    place_BP = torch.where(kept_BP, kept_BP.cumsum(1) - 1, ev.top_k)  # the last one is cut off
    in_row_P = pixel_P % (height * width)
    centers = [
        height_BP.new_full((images, ev.top_k + 1), torch.inf).scatter(
            1, place_BP, value_P.to(height_BP).expand(images, -1)
        )
        for value_P in (in_row_P // width, in_row_P % width)
    ]
    most = ev.top_k if torch.compiler.is_exporting() else max(int(count_B.max()), 1)
    return torch.stack(centers, 2)[:, :most], count_B


def group(
    class_BHW: Tensor,
    centers_BK2: Tensor,
    count_B: Tensor,
    offset_B2HW: Tensor,
    things: tuple[int, ...],
    stuff_area: int,
) -> Tensor:
    """`panoptic` from `classes` and the centers on."""
    images, height, width = class_BHW.shape
    K, device = centers_BK2.shape[1], class_BHW.device
    pixel_N = pixels.where(pixels.member(class_BHW, things))
    row_N = torch.div(pixel_N.int(), width, rounding_mode="trunc")
    column_N = pixel_N.int() - row_N * width
    image_N, y_N = torch.zeros_like(pixel_N), row_N
    if images > 1:
        image_N, y_N = row_N.long() // height, row_N % height
    target_2N = torch.stack(
        [
            own_N.float() + offset_B2HW[:, axis].flatten().index_select(0, pixel_N).float()
            for axis, own_N in enumerate((y_N, column_N))
        ]
    )
    nearest_N = nearest(target_2N, image_N, centers_BK2, count_B, (height, width))
    instance_N = image_N * K + nearest_N

    # One vote per pixel: a table instance x class, filled by a single count
    order = sorted(things)
    thing_T = torch.tensor(order, device=device, dtype=torch.int32)
    place_of = [order.index(c) if c in things else 0 for c in range(IGNORE + 1)]
    place = torch.tensor(place_of, device=device)
    class_N = class_BHW.flatten().index_select(0, pixel_N).int()
    vote_N = instance_N * len(order) + place.index_select(0, class_N)
    votes = _count(vote_N, images * K * len(order))
    votes = votes.view(-1, len(order)) * len(order)
    votes = votes - torch.arange(len(order), device=device)  # ties go to the lowest
    number_K = torch.arange(1, K + 1, device=device, dtype=torch.int32).repeat(images)
    id_K = thing_T.index_select(0, votes.argmax(1)) * DIVISOR + number_K
    id_N = id_K.index_select(0, instance_N)
    id_N = torch.where((count_B > 0).index_select(0, image_N), id_N, class_N * DIVISOR)
    stuff_BHW = _stuff(class_BHW, things, stuff_area)
    return stuff_BHW.flatten().scatter_(0, pixel_N, id_N).view_as(class_BHW)


def to_instance_ids(panoptic_BHW: Tensor, labels: LabelSet) -> Tensor:
    """Cityscapes' ids, int32: label id, or label id * 1000 + instance; 0 for what is not evaluated.

    A thing pixel without an instance keeps its bare label id: one segment of its class.
    """
    label_of_class = [label.label_id if label.evaluated else 0 for label in labels.labels]
    label_C1 = torch.tensor(label_of_class, dtype=torch.int32)[:, None]
    id_CN = torch.where(label_C1 > 0, label_C1 * DIVISOR + torch.arange(DIVISOR).int(), 0)
    id_CN[:, :1] = label_C1
    id_V = torch.cat([id_CN.new_zeros(-VOID), id_CN.flatten()]).to(panoptic_BHW.device)
    return id_V.index_select(0, panoptic_BHW.flatten() - VOID).view_as(panoptic_BHW)


def _stuff(class_BHW: Tensor, things: tuple[int, ...], least: int) -> Tensor:
    """Ids without instances: VOID where a stuff class covers too little of its image, or none."""
    if torch.compiler.is_exporting():
        return _stuff_by_class(class_BHW, things, least)
    device = class_BHW.device
    least_V = [0 if c in things else least for c in range(IGNORE)]
    none = class_BHW[0].numel() + 1  # no area is as large
    keep_BV = pixels.areas(class_BHW) >= torch.tensor([*least_V, none], device=device)
    id_V = torch.arange(len(least_V) + 1, device=device, dtype=torch.int32) * DIVISOR
    return pixels.look_up(id_V.masked_fill(~keep_BV, VOID), class_BHW)


def _stuff_by_class(class_BHW: Tensor, things: tuple[int, ...], least: int) -> Tensor:
    """The same in comparisons: ONNX Runtime counts and looks up in tables ten times slower (and
    adds integers slower than floats).

    Stuff comes before things, as in every LabelSet.
    """
    drop_BHW = class_BHW == IGNORE
    for c in set(range(max(things) + 1)) - set(things):
        is_c_BHW = class_BHW == c
        area_B11 = is_c_BHW.float().sum(2, keepdim=True).sum(1, keepdim=True)  # exact below 2 ** 24
        drop_BHW = drop_BHW | (is_c_BHW & (area_B11 < least))
    return torch.where(drop_BHW, VOID, class_BHW * DIVISOR)


def _count(index_N: Tensor, size: int) -> Tensor:
    """How often each of the numbers below `size` occurs."""
    if not torch.compiler.is_exporting():
        return torch.bincount(index_N, minlength=size)
    ones_N = torch.ones_like(index_N)
    return torch.zeros(size, dtype=index_N.dtype, device=index_N.device).scatter_add(
        0, index_N, ones_N
    )
