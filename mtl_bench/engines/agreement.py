"""Whether an engine computes the same as the plain network: said before it is timed.

An instance is what it covers: its number may differ, as numbers follow the reading order of the
centers and one center more shifts all that come after it.
"""

import math
from dataclasses import dataclass, field

import torch
import torch.nn.functional as F
from torch import Tensor

from mtl_bench.core.geometry import depth_from_inverse
from mtl_bench.engines.base import Maps
from mtl_bench.tasks.panoptic.postprocess import DIVISOR

LIMITS = {  # precision -> least share of equal panoptic pixels, largest median of relative depth
    "fp32": (0.999, 1e-3),
    "fp16": (0.99, 5e-3),
    "bf16": (0.95, 2e-2),  # 8 bits of mantissa: 0.4 % a rounding
}
# Of random weights classes and centers all but tie, so that pixels say little: the maps are judged,
# by the root mean square of their difference over their own deviation. Measured on the four shipped
# backbones, 512x1024, in part 1024x2048: fp32 up to 4e-5, fp16 0.014 (ResNet18's inverse depth 0.1:
# beyond the limit), bf16 0.08; red and blue exchanged, logits alone, 0.14 to 0.25.
RANDOM = {"fp32": 1e-3, "fp16": 0.05, "bf16": 0.1}


@dataclass
class Agreement:
    """Adds up over images."""

    logits_max: float = 0.0
    maps_rms: float = 0.0  # of the map that differs most, over the plain map's standard deviation
    equal: list[float] = field(default_factory=list)  # share, an image
    median: list[float] = field(default_factory=list)  # of |depth / plain depth - 1|, an image
    depth_max: float = 0.0

    def update(
        self, plain: tuple[Maps, dict[str, Tensor]], other: tuple[Maps, dict[str, Tensor]]
    ) -> None:
        """One image: maps and what `finish.Finish` makes of them.

        What is not finite in `other` is never near to what is.
        """
        (maps_a, done_a), (maps_b, done_b) = plain, other
        if maps_a.logits_BChw is not None and maps_b.logits_BChw is not None:
            logits = maps_b.logits_BChw
            if logits.shape != maps_a.logits_BChw.shape:
                size = maps_a.logits_BChw.shape[2:]
                logits = F.interpolate(logits, size, mode="bilinear", align_corners=True)
            self.logits_max = _largest(self.logits_max, logits - maps_a.logits_BChw)
            self._map(maps_a.logits_BChw, logits)
            self._map(maps_a.center_B1HW, maps_b.center_B1HW)
            self._map(maps_a.offset_B2HW, maps_b.offset_B2HW)
            self.equal.append(equal_share(done_a["panoptic"], done_b["panoptic"]))
        if maps_a.inverse_B1HW is not None and maps_b.inverse_B1HW is not None:
            self._map(maps_a.inverse_B1HW, maps_b.inverse_B1HW)
            # before the scale, which is no number where no road is found
            depth_a, depth_b = map(depth_from_inverse, (maps_a.inverse_B1HW, maps_b.inverse_B1HW))
            off = depth_b / depth_a - 1
            self.median.append(float(off.abs().nan_to_num(torch.inf).median()))
            self.depth_max = _largest(self.depth_max, off)

    def _map(self, plain: Tensor | None, other: Tensor | None) -> None:
        assert plain is not None
        assert other is not None
        off = ((other - plain) / plain.std().clamp(min=1e-9)).square().mean().sqrt()
        self.maps_rms = _largest(self.maps_rms, off)

    def values(self) -> dict[str, float]:
        found = {}
        if self.equal:
            found["logits_max"] = self.logits_max
            found["panoptic_equal"] = sum(self.equal) / len(self.equal)
        if self.median:
            found["depth_median_rel"] = max(self.median)
            found["depth_max_rel"] = self.depth_max
        return {f"agreement.{key}": value for key, value in found.items()}

    def wrong(self, precision: str, trained: bool = True) -> str:
        """What is beyond the precision's limits, in words; empty where all is within."""
        least, largest = LIMITS[precision]
        values, faults = self.values(), []
        equal = values.get("agreement.panoptic_equal", 1.0)
        median = values.get("agreement.depth_median_rel", 0.0)
        if not trained and not self.maps_rms <= RANDOM[precision]:
            faults.append(
                f"maps {self.maps_rms:.2g} of their deviation (limit {RANDOM[precision]})"
            )
        if trained and not equal >= least:
            faults.append(f"{100 * equal:.2f} % equal panoptic pixels (limit {100 * least:g} %)")
        if not median <= largest:
            faults.append(f"median relative depth difference {median:.2g} (limit {largest:g})")
        if not math.isfinite(sum(values.values())):
            faults.append("values that are not finite")
        return ", ".join(faults)


def equal_share(a_BHW: Tensor, b_BHW: Tensor) -> float:
    """Share of pixels of the same class and the same instance: two that cover each other most."""
    a_ids, a_N = a_BHW.flatten().unique(return_inverse=True)
    b_ids, b_N = b_BHW.flatten().unique(return_inverse=True)
    counts = torch.bincount(a_N * len(b_ids) + b_N, minlength=len(a_ids) * len(b_ids))
    counts_ab = counts.view(len(a_ids), len(b_ids))
    place_a = torch.arange(len(a_ids), device=a_ids.device)
    partner_a = counts_ab.argmax(1)
    fits_a = counts_ab.argmax(0)[partner_a] == place_a
    fits_a &= a_ids // DIVISOR == b_ids[partner_a] // DIVISOR
    return float(counts_ab[place_a, partner_a][fits_a].sum() / a_BHW.numel())


def _largest(before: float, difference: Tensor) -> float:
    return max(before, float(difference.abs().nan_to_num(torch.inf, torch.inf).max()))
