"""Regressions of one input whose losses differ ten-thousandfold: made, to part methods by scale.

Source: after the toy problem of GradNorm (Chen et al., ICML 2018, section 4): number k is
sigma_k times a function of its own and one that all share. Departures: the scales are spaced
evenly on a logarithmic axis about 1, `norm_ratio` from end to end; the functions are sums of
products, which no features but learned ones explain, and some noise; the input is an image of 8-bit
noise.
"""

from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray

from mtl_bench.core.dataset import DecodedFrame, Kind
from mtl_bench.core.labels import LabelSet
from mtl_bench.core.recipe import Data
from mtl_bench.data._in_memory import InMemory

UNITS = 4  # of a function: two products
NOISE = 0.1  # share of the variance that nothing explains, so that changes in percent stay small
OWN = 0.7  # of a function's directions that no other has, against the shared part
Functions = Callable[[NDArray[np.float64], Data], NDArray[np.float64]]


class Scales(InMemory):
    """Images whose pixels are numbers, and up to ten numbers to regress."""

    made_of = (*InMemory.made_of, "heads", "cosine", "norm_ratio")
    labels = LabelSet("numbers", ())
    layout = "Numbers that are made from a seed"
    predicts: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "regress": ("y0", "y1", "y2", "y3", "y4", "y5", "y6", "y7", "y8", "y9")
    }
    fields: ClassVar[Mapping[str, Kind]] = dict.fromkeys(predicts["regress"], Kind.VECTOR)

    def open_split(self) -> None:
        data, names = self.data, self.predicts["regress"]
        if not 2 <= data.heads <= len(names):
            raise ValueError(f"recipe.data.heads = {data.heads}: from 2 to {len(names)}")
        lacking = sorted(self.needs - {*names[: data.heads]})
        if lacking:
            raise ValueError(
                f"{data.dataset} with recipe.data.heads = {data.heads} has no {lacking[0]}"
            )
        self.pixels_N3HW, functions_NK = _made(self.functions, data, self.split)
        scale_K = data.norm_ratio ** np.linspace(-0.5, 0.5, data.heads)
        self.truth_NK = torch.from_numpy((functions_NK * scale_K).astype(np.float32))
        truth = zip(names, self.truth_NK.split(1, dim=1), strict=False)
        self.numbers = {name: truth_N1.unbind() for name, truth_N1 in truth if name in self.needs}
        self.names = [f"{self.split}{number}" for number in range(len(self.truth_NK))]

    @staticmethod
    def functions(x_ND: NDArray[np.float64], data: Data) -> NDArray[np.float64]:
        """[N,K] of mean 0 and variance 1: what the numbers are before they are scaled."""
        draw = np.random.default_rng([data.seed, 1])
        shape = (x_ND.shape[1], UNITS)
        shared_DU = draw.standard_normal(shape)
        own_KDU = draw.standard_normal((data.heads, *shape))
        return products((1 - OWN**2) ** 0.5 * shared_DU + OWN * own_KDU, x_ND)

    def read(self, name: str) -> DecodedFrame:
        index = int(name.removeprefix(self.split))
        return DecodedFrame(
            images_N3HW=[self.pixels_N3HW[index]],
            fields={name: number_1[index] for name, number_1 in self.numbers.items()},
        )


def products(directions_KDU: NDArray[np.float64], x_ND: NDArray[np.float64]) -> NDArray[np.float64]:
    """[N,K]: sums of products of two units each, a unit being tanh(2 x.direction / sqrt(D))."""
    unit_KNU = np.tanh(2 * x_ND @ (directions_KDU / x_ND.shape[1] ** 0.5))
    found: NDArray[np.float64] = (unit_KNU[..., ::2] * unit_KNU[..., 1::2]).sum(-1).T
    return found


@lru_cache(maxsize=4)
def _made(functions: Functions, data: Data, split: str) -> tuple[torch.Tensor, NDArray[np.float64]]:
    """Pixels [N,3,H,W] of a split, and the functions [N,K] of them, of the training split's mean 0
    and variance 1."""
    counts = (data.train_scenes, data.val_scenes, data.test_scenes)
    shape = (sum(counts), 3, data.height, data.width)
    pixels = np.random.default_rng([data.seed, 0]).integers(0, 256, shape, np.uint8)
    x_ND = (pixels.reshape(len(pixels), -1) / 255 - 0.5) * 12**0.5  # of variance 1
    functions_NK = functions(x_ND, data)
    training = functions_NK[: counts[0]]
    functions_NK = (functions_NK - training.mean(0)) / training.std(0)
    noise_NK = np.random.default_rng([data.seed, 2]).standard_normal(functions_NK.shape)
    functions_NK = (1 - NOISE) ** 0.5 * functions_NK + NOISE**0.5 * noise_NK
    chosen = Scales.split_index(split)
    of_split = slice(sum(counts[:chosen]), sum(counts[: chosen + 1]))
    return torch.from_numpy(pixels[of_split]), functions_NK[of_split]
