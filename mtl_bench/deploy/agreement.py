"""Whether an engine computes the same as the plain network: said before it is timed.

An instance is what it covers: its number may differ, as numbers follow the reading order of the
centers and one center more shifts all that come after it.
"""

import math
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
import torch.nn.functional as F
from torch import Tensor

from mtl_bench.core.geometry import depth_from_inverse
from mtl_bench.core.labels import DIVISOR
from mtl_bench.core.task import MapInfo, Results
from mtl_bench.deploy.maps import Maps

LIMITS = {  # precision -> least share of equal ids' pixels, largest median of a relative difference
    "fp32": (0.999, 1e-3),
    "fp16": (0.99, 5e-3),
    "bf16": (0.95, 2e-2),  # 8 bits of mantissa: 0.4 % a rounding
    "int8": (0.95, 2e-2),  # of whoever would take bf16
}
# Of random weights classes and centers all but tie, so that pixels say little: the maps are judged,
# by the root mean square of their difference over their own deviation. Measured on the four shipped
# backbones, 512x1024, in part 1024x2048: fp32 up to 4e-5, fp16 0.014, bf16 0.08; red and blue
# exchanged, logits alone, 0.14 to 0.25. ResNet18's fp16 is beyond the limit (0.1): its inverse
# depth is 1 +- 0.0015, and OpenVINO computes the last sigmoid in fp16, too, in steps of 0.0005 or
# more; before it the map is off by 0.003. In bf16 it keeps what follows the last convolution.
RANDOM = {"fp32": 1e-3, "fp16": 0.05, "bf16": 0.1, "int8": 0.1}
EQUAL, MEDIAN = "_equal", "_median_rel"  # ends of measures
RMS = "agreement.maps_rms"


@dataclass
class Agreement:
    """Adds up over images."""

    infos: Mapping[str, MapInfo]  # by the maps' names
    maps_rms: float = 0.0  # of the map that differs most, over the plain map's standard deviation
    measures: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))  # by image
    # Of maps that no ids or quantity of their task speak for: squares of differences, and of values
    squares: dict[str, Tensor] = field(default_factory=dict)

    def update(
        self, plain: tuple[Maps, dict[str, Results]], other: tuple[Maps, dict[str, Results]]
    ) -> None:
        """One image: maps, and what post-processing makes of them by task.

        What is not finite in `other` is never near to what is.
        """
        (maps_a, done_a), (maps_b, done_b) = plain, other
        judged = {
            task_of(name) for name, about in self.infos.items() if about.ids or about.quantity
        }
        for name, about in self.infos.items():
            a, b, task = maps_a[name], maps_b[name], task_of(name)
            if b.shape != a.shape:
                b = F.interpolate(b, a.shape[2:], mode="bilinear", align_corners=True)
            spread = a.std() if a.numel() > 1 else a.abs()  # one number has no deviation
            off_by = ((b - a) / spread.clamp(min=1e-9)).square().mean().sqrt()
            self.maps_rms = max(self.maps_rms, _largest(off_by))
            if task not in judged:
                own = torch.stack(
                    [(b - a).double().square().sum(), a.double().square().sum()]
                ).cpu()
                self.squares[name] = self.squares.get(name, torch.zeros_like(own)) + own
            if about.ids:
                ids_a, ids_b = done_a[task][about.ids], done_b[task][about.ids]
                self.measures[f"{about.words}_max"].append(_largest(b - a))
                self.measures[f"{about.ids}{EQUAL}"].append(equal_share(ids_a, ids_b))
            if about.quantity:  # before its scale, which is no number where no road is found
                off = depth_from_inverse(b) / depth_from_inverse(a) - 1
                median = float(off.abs().nan_to_num(torch.inf).median())
                self.measures[f"{about.quantity}{MEDIAN}"].append(median)
                self.measures[f"{about.quantity}_max_rel"].append(_largest(off))

    def values(self) -> dict[str, float]:
        """`agreement.*`: the mean share of equal pixels, the largest of all differences; of maps
        that only their values speak for, the largest relative root mean square over the images."""
        apart = [
            _largest((off / own.clamp(min=1e-18)).sqrt()) for off, own in self.squares.values()
        ]
        found = {RMS: max(apart)} if apart else {}
        return found | {
            f"agreement.{key}": sum(each) / len(each) if key.endswith(EQUAL) else max(each)
            for key, each in self.measures.items()
        }

    def wrong(self, precision: str, trained: bool = True) -> str:
        """What is beyond the precision's limits, in words; empty where all is within."""
        least, largest = LIMITS[precision]
        values, faults = self.values(), []
        if not trained and not self.maps_rms <= RANDOM[precision]:
            faults.append(
                f"maps {self.maps_rms:.2g} of their deviation (limit {RANDOM[precision]})"
            )
        for key, value in values.items():
            what = key.removeprefix("agreement.").partition("_")[0]
            if trained and key.endswith(EQUAL) and not value >= least:
                faults.append(f"{100 * value:.2f} % equal {what} pixels (limit {100 * least:g} %)")
            if trained and key == RMS and not value <= RANDOM[precision]:
                faults.append(f"maps {value:.2g} of their size (limit {RANDOM[precision]})")
            if key.endswith(MEDIAN) and not value <= largest:
                faults.append(f"median relative {what} difference {value:.2g} (limit {largest:g})")
        if not math.isfinite(sum(values.values())):
            faults.append("values that are not finite")
        return ", ".join(faults)


def task_of(name: str) -> str:
    """Of a map's flat name."""
    return name.partition(".")[0]


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


def _largest(difference: Tensor) -> float:
    return float(difference.abs().nan_to_num(torch.inf, torch.inf).max())
