"""FairGrad: an update whose use for the tasks is alpha-fair, as networks share their capacity.

Source: Ban, Ji, Fair Resource Allocation in Multi-Task Learning, ICML 2024, arXiv:2402.15638,
equation 4, solved as the convex problem that it is. The authors' code starts a general root finder
at 1/K, which does not arrive where norms differ much. Gradients that cancel have no solution; see
`fair` in _solvers.py for what is done there.
"""

from collections.abc import Sequence

from torch import Tensor

from mtl_bench.core.method import GradientMethod, Step
from mtl_bench.core.terms import Term

from ._solvers import fair


class FairGrad(GradientMethod):
    """w > 0 with (G w)_i = w_i^(-1/alpha)

    Args:
        alpha: 1 is proportional fairness, and Nash-MTL without its clipping; 2 the least potential
            delay; towards infinity, max-min. 1 in LibMTL.
    """

    space = {"alpha": [1.0, 2.0]}

    weighted_heads = True

    def __init__(self, terms: Sequence[Term], seed: int = 0, alpha: float = 1.0):
        super().__init__(terms, seed)
        if not alpha > 0:
            raise ValueError(f"alpha {alpha} must be above 0; 0 is the plain sum, a fixed weight")
        self.alpha = alpha

    def weights(self, G_KK: Tensor, step: Step) -> Tensor:
        return fair(G_KK, power=1 / self.alpha)
