"""Impartial multi-task learning: learned scales bring all losses to 1, then equal projections.

Source: Liu, Li, Kuang, Xue, Chen, Yang, Liao, Zhang, Towards Impartial Multi-Task Learning,
ICLR 2021, openreview.net/forum?id=IMPnRXEWpvr, algorithm 1: loss balance for what belongs to one
task, gradient balance on the scaled losses for what is shared. It is `imtl_l+imtl_g` by one name.
"""

from collections.abc import Sequence

from mtl_bench.core.method import Composed
from mtl_bench.core.terms import Term

from .imtl_g import ImpartialGradient
from .imtl_l import ImpartialLoss


class Impartial(Composed):
    """The gradients of exp(s_i) L_i, s_i from `imtl_l`, combined by `imtl_g`

    Args:
        init: every s_i at the start; 0 in the paper.
        paper_sum: as in `imtl_g`.
    """

    def __init__(
        self, terms: Sequence[Term], seed: int = 0, init: float = 0.0, paper_sum: bool = False
    ):
        loss = ImpartialLoss(terms, seed, init=init)
        super().__init__(loss, ImpartialGradient(terms, seed, paper_sum=paper_sum))
