"""Loss terms: batch x outputs -> unweighted scalars, in at least float32 whatever autocast does."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mtl_bench.core import config
from mtl_bench.core.terms import TERMS, Term, gather, terms_of
from mtl_bench.data.batch import Batch
from mtl_bench.tasks.depth.photometric import photometric_loss
from mtl_bench.tasks.depth.smoothness import smoothness_loss
from mtl_bench.tasks.panoptic.instance_loss import center_loss, offset_loss
from mtl_bench.tasks.panoptic.semantic_loss import semantic_loss

if TYPE_CHECKING:
    from mtl_bench.model import Outputs

__all__ = ["TERMS", "Term", "gather", "loss_terms", "terms_of"]


def loss_terms(
    batch: Batch,
    outputs: Outputs,
    transforms_BN44: Tensor | None,
    loss: config.Loss,
    tasks: Iterable[str],
) -> dict[str, Tensor]:
    """The terms of these tasks, in the order of TERMS; zero, in the graph, where no pixel counts.

    A task whose labels (or, for depth, neighbours in time) the batch lacks has no terms.

    Args:
        transforms_BN44: from the pose network, target camera to context cameras; depth task only.

    Raises:
        ValueError: a task without terms, or a scale that the outputs do not have.
    """
    tasks = {term.task for term in terms_of(tasks)}
    values: dict[str, Tensor] = {}
    with torch.autocast(batch.image_B3HW.device.type, enabled=False):
        if "panoptic" in tasks and batch.semantic_BHW is not None:
            values |= _panoptic(batch, outputs, loss)
        if "depth" in tasks and batch.clean_context_BN3HW is not None:
            values |= _depth(batch, outputs, transforms_BN44, loss)
    return values


def _panoptic(batch: Batch, outputs: Outputs, loss: config.Loss) -> dict[str, Tensor]:
    semantic, semantic_weight = _full(outputs.semantic_BCHW), _full(batch.semantic_weight_BHW)
    assert batch.semantic_BHW is not None
    return {
        "semantic": semantic_loss(semantic, batch.semantic_BHW, semantic_weight, loss.top_fraction),
        "center": center_loss(
            _full(outputs.center_B1HW), _full(batch.center_B1HW), _full(batch.center_weight_B1HW)
        ),
        "offset": offset_loss(
            _full(outputs.offset_B2HW), _full(batch.offset_B2HW), _full(batch.offset_weight_B1HW)
        ),
    }


def _depth(
    batch: Batch, outputs: Outputs, transforms_BN44: Tensor | None, loss: config.Loss
) -> dict[str, Tensor]:
    available = len(outputs.inverse_depth)
    if not loss.scales or not all(0 <= scale < available for scale in loss.scales):
        raise ValueError(
            f"recipe.loss.scales = {list(loss.scales)}, but the network has the depth outputs "
            f"{list(range(available))}: name one or more of those"
        )
    inverse_SB1HW = [_full(outputs.inverse_depth[scale]) for scale in loss.scales]
    target_B3HW, mask_BHW = _full(batch.clean_B3HW), batch.reprojection_mask_BHW
    assert mask_BHW is not None
    photometric = photometric_loss(
        target_B3HW,
        _full(batch.clean_context_BN3HW),
        inverse_SB1HW,
        _full(batch.K_B33),
        mask_BHW,
        _full(transforms_BN44),
        ssim_weight=loss.ssim_weight,
        automask=loss.automask,
    )
    return {
        "photometric": photometric,
        "smoothness": smoothness_loss(inverse_SB1HW, loss.scales, target_B3HW, mask_BHW),
    }


def _full(tensor: Tensor | None) -> Tensor:
    """At least float32; what a task needs is there, or the loader or the network is wrong."""
    assert tensor is not None
    return tensor.to(torch.promote_types(tensor.dtype, torch.float32))
