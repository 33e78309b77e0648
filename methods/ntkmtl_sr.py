"""NTKMTL-SR: NTKMTL on the gradients of what the decoders read; the encoder runs backwards once.

Source: Qin, Wang, Liao, Yan, NTKMTL: Mitigating Task Imbalance in Multi-Task Learning from Neural
Tangent Kernel Perspective, NeurIPS 2025, section 3.4. Departure: one mini-batch where the paper
takes four, of the largest eigenvalue of whose kernel this is an estimate. See `ntkmtl` for the
others.
"""

from .ntkmtl import NTKMTL


class NTKMTLSharedRepresentation(NTKMTL):
    """w_i = sqrt(mean_j(l_j) / l_i) with l_i = |dL_i/dz|^2, z the shared representation"""

    needs = "representation"
