"""Regressions that compete for what a trunk can hold: made, with a chosen cosine and norm ratio.

Source: where capacity is scarce, scalarisation cannot reach all trade-offs (Hu et al., NeurIPS
2023): a trunk narrower than the number of functions serves some at the cost of others. The
functions have mean 0, variance 1 and the cosine `recipe.data.cosine` with each other over the
images; number k is one of them with some noise, scaled as those of `scales` are. At cosine 1 they
are one function, and nothing conflicts. The trunk's width is `recipe.network.channels`.
"""

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from mtl_bench.core.dataset import Kind
from mtl_bench.core.recipe import Data
from mtl_bench.data.scales import Scales, products


class Conflict(Scales):
    """Images whose pixels are numbers, and up to ten numbers to regress."""

    predicts: ClassVar[Mapping[str, tuple[str, ...]]] = {
        "regress": ("c0", "c1", "c2", "c3", "c4", "c5", "c6", "c7", "c8", "c9")
    }
    fields: ClassVar[Mapping[str, Kind]] = dict.fromkeys(predicts["regress"], Kind.VECTOR)

    @staticmethod
    def functions(x_ND: NDArray[np.float64], data: Data) -> NDArray[np.float64]:
        """[N,K] with the chosen cosine between any two.

        Raises:
            ValueError: a cosine that so many functions cannot have.
        """
        least = -1 / (data.heads - 1)
        if not least <= data.cosine <= 1:
            raise ValueError(
                f"recipe.data.cosine = {data.cosine:g}: of {data.heads} functions, any two have "
                f"{least:.3g} to 1"
            )
        draw = np.random.default_rng([data.seed, 3])
        independent_NK = products(draw.standard_normal((data.heads, x_ND.shape[1], 2)), x_ND)
        independent_NK -= independent_NK.mean(0)
        basis_NK = np.linalg.qr(independent_NK)[0] * len(x_ND) ** 0.5  # cosines exactly 0
        cosines_KK = np.full((data.heads, data.heads), data.cosine)
        np.fill_diagonal(cosines_KK, 1)
        values_K, vectors_KK = np.linalg.eigh(cosines_KK)
        root_KK = vectors_KK * values_K.clip(0) ** 0.5 @ vectors_KK.T
        found: NDArray[np.float64] = basis_NK @ root_KK
        return found
