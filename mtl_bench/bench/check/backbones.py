"""What every backbone has to hold."""

from collections.abc import Callable
from typing import Any

import torch


def _pyramid(kind: Callable[..., Any]) -> None:
    usual, *others = ((8, 16, 32), (4, 8, 16), (2, 4, 8))
    for strides in (usual, *others):
        try:
            backbone = kind(strides=strides).eval()
        except ValueError:  # it has no such level, and says so
            if strides == usual:
                raise
            continue
        for height, width in ((64, 64), (96, 160)):
            features = backbone(torch.rand(2, 3, height, width))
            for stride in strides:
                expected = (2, backbone.channels[stride], height // stride, width // stride)
                found = tuple(features[stride].shape)
                if found != expected:
                    raise ValueError(f"stride {stride}: {found} is not {expected}")


def _every_parameter_trains(kind: Callable[..., Any]) -> None:
    """All but those that it has frozen."""
    backbone = kind(strides=(8, 16, 32)).train()
    wanted = {name: p for name, p in backbone.named_parameters() if p.requires_grad}
    if wanted:
        sum(f.square().mean() for f in backbone(torch.rand(2, 3, 64, 64)).values()).backward()
    idle = [name for name, p in wanted.items() if p.grad is None]
    if idle:
        raise ValueError(f"parameters without a gradient: {', '.join(idle[:5])}")


def _backbone_round_trip(kind: Callable[..., Any]) -> None:
    first, second, image = kind().eval(), kind().eval(), torch.rand(1, 3, 64, 64)
    second.load_state_dict(first.state_dict())
    for stride, features in first(image).items():
        if not torch.equal(features, second(image)[stride]):
            raise ValueError(f"stride {stride} differs after the state was copied")


BACKBONE_CHECKS: dict[str, Callable[[Callable[..., Any]], None]] = {
    "pyramid as declared": _pyramid,
    "every parameter trains": _every_parameter_trains,
    "state round trip": _backbone_round_trip,
}
