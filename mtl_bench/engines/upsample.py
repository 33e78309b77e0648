"""From maps at the network's finest stride to the image's size, where most of the pixels are cheap.

Bilinear with aligned corners, as in the network. Twenty full-size maps of logits are written and
read again only to find each pixel's largest: at 1024x2048 that takes longer than the network does
in bf16. Here a cell is the image between four neighbouring logits. A class that is largest at all
four corners is largest in between, as every pixel is a weighted mean of them with positive weights;
only cells whose corners differ are interpolated.
Shapes: C classes, h x w of the maps, H x W of the image, m mixed cells, P rows or columns a cell.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

CHUNK = 2**19  # logits held at once: what a core's cache holds


class Upsample:
    """For one pair of sizes.

    Args:
        small: h, w of the maps, each 2 or more.
        large: H, W of the image, not smaller.
    """

    def __init__(self, small: tuple[int, int], large: tuple[int, int], device: torch.device):
        self.size = large
        self._row_H, self._down_Ph, self._fy_Ph = _axis(small[0], large[0], device)
        self._column_W, self._right_Pw, self._fx_Pw = _axis(small[1], large[1], device)

    def values(self, maps_BChw: Tensor) -> Tensor:
        """Every pixel of every map, float32."""
        return F.interpolate(maps_BChw.float(), self.size, mode="bilinear", align_corners=True)

    def classes(self, logits_BChw: Tensor) -> Tensor:
        """Index [B,H,W] (uint8) of the largest of the interpolated logits; of equals the first."""
        if logits_BChw.device.type == "cuda":  # has the bandwidth, and would wait for the host
            return self.values(logits_BChw).argmax(1).to(torch.uint8)
        return torch.stack([self._classes(logits_Chw) for logits_Chw in logits_BChw.float()])

    def _classes(self, logits_Chw: Tensor) -> Tensor:
        logits_Chw = logits_Chw.contiguous()
        best_hw = _first_largest(logits_Chw)
        corner = best_hw[:-1, :-1]
        mixed = (corner != best_hw[1:, :-1]) | (corner != best_hw[:-1, 1:])
        mixed |= corner != best_hw[1:, 1:]
        result_HW = corner.index_select(1, self._column_W).index_select(0, self._row_H)
        flat_N = result_HW.view(-1)
        i_M, j_M = mixed.nonzero(as_tuple=True)
        step = max(CHUNK // (len(logits_Chw) * len(self._fy_Ph) * len(self._fx_Pw)), 1)
        for i_m, j_m in zip(i_M.split(step), j_M.split(step), strict=True):
            class_PPm = _first_largest(self._cells(logits_Chw, i_m, j_m))
            row_P1m, column_Pm = self._down_Ph[:, None, i_m], self._right_Pw[:, j_m]
            at_PPm = row_P1m * self.size[1] + column_Pm
            flat_N.scatter_(0, at_PPm.flatten(), class_PPm.flatten())
        return result_HW

    def _cells(self, logits_Chw: Tensor, i_m: Tensor, j_m: Tensor) -> Tensor:
        """Logits [C,P,P,m] of all pixels of cells; cells last, so that every step is vectorised."""
        flat_CN, width = logits_Chw.flatten(1), logits_Chw.shape[2]
        at_m = i_m * width + j_m
        fx_Pm, fy_P1m = self._fx_Pw[:, j_m], self._fy_Ph[:, None, i_m]

        def along_x(start_m: Tensor) -> Tensor:
            left_C11m = flat_CN.index_select(1, start_m)[:, None, None]
            right_C11m = flat_CN.index_select(1, start_m + 1)[:, None, None]
            return left_C11m * (1 - fx_Pm) + right_C11m * fx_Pm

        upper_C1Pm, lower_C1Pm = along_x(at_m), along_x(at_m + width)
        return (upper_C1Pm * (1 - fy_P1m)).addcmul_(lower_C1Pm, fy_P1m)


def _axis(few: int, many: int, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """Of one axis: each pixel's cell [many]; each cell's pixels [P,few-1], and how far each is from
    the cell's start to its end. Cells of fewer than P pixels name their last one again."""
    position = torch.arange(many, dtype=torch.float32) * ((few - 1) / max(many - 1, 1))
    cell = position.long().clamp(max=few - 2)
    count = torch.bincount(cell, minlength=few - 1)
    first = count.cumsum(0) - count
    place = torch.arange(int(count.max()))[:, None].minimum((count - 1).clamp(min=0))
    pixel = first + place
    fraction = position[pixel] - torch.arange(few - 1)
    return cell.to(device), pixel.to(device), fraction.to(device)


def _first_largest(x_C: Tensor) -> Tensor:
    """Index (uint8) of the first largest along the first axis: one pass, vectorised on the CPU."""
    best, index = x_C[0].clone(), torch.zeros_like(x_C[0], dtype=torch.uint8)
    for number, candidate in enumerate(x_C[1:], 1):
        index.masked_fill_(candidate > best, number)
        torch.maximum(best, candidate, out=best)
    return index
