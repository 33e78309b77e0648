"""MGDA-UB: MGDA on the gradients of what the decoders read, whose norm bounds those behind it.

Source: Sener, Koltun, Multi-Task Learning as Multi-Objective Optimization, NeurIPS 2018,
arXiv:1810.04650, section 3.3 and algorithm 2. The encoder is run backwards once, whatever the
number of tasks. In LibMTL it is a switch, with which methods that never were derived for it leave
the encoder without any gradient; here the method declares it.
"""

from .mgda import MGDA


class MGDAUpperBound(MGDA):
    """argmin |sum_i w_i dL_i/dz / n_i| over w >= 0 with sum 1, z the shared representation

    Args:
        normalize: as in `mgda`.
    """

    space = {"normalize": ["none", "l2", "loss", "loss+"]}

    needs = "representation"
