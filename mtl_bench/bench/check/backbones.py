"""What every backbone has to hold."""

from collections.abc import Callable

import torch
from torch import Tensor

from mtl_bench.core.backbone import VECTOR, Backbone

SIZE = (64, 64)  # of the images


def _strides(kind: type[Backbone]) -> list[tuple[int, ...]]:
    """Three levels where it can give so many, else what it gives."""
    several = ((8, 16, 32), (4, 8, 16), (2, 4, 8))
    return [three for three in several if set(three) <= set(kind.offered)] or [kind.offered]


def _features(kind: type[Backbone]) -> None:
    """A pyramid, or a vector, of the declared shapes."""
    if kind.vector:
        for size, outputs in ((SIZE, 8), ((16, 32), 5)):
            backbone = kind(size=size, outputs=outputs).eval()
            found = {key: tuple(f.shape) for key, f in backbone(torch.rand(2, 3, *size)).items()}
            if found != {VECTOR: (2, outputs)} or backbone.channels != {VECTOR: outputs}:
                raise ValueError(f"{found} is not a vector of {outputs}, or not under VECTOR")
        return
    usual, *others = _strides(kind)
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
                shape = tuple(features[stride].shape)
                if shape != expected:
                    raise ValueError(f"stride {stride}: {shape} is not {expected}")


def _every_parameter_trains(kind: type[Backbone]) -> None:
    """All but those that it has frozen."""
    backbone = (kind(size=SIZE) if kind.vector else kind(strides=_strides(kind)[0])).train()
    wanted = {name: p for name, p in backbone.named_parameters() if p.requires_grad}
    if wanted:
        features: dict[int, Tensor] = backbone(torch.rand(2, 3, *SIZE))
        torch.stack([f.square().mean() for f in features.values()]).sum().backward()
    idle = [name for name, p in wanted.items() if p.grad is None]
    if idle:
        raise ValueError(f"parameters without a gradient: {', '.join(idle[:5])}")


def _backbone_round_trip(kind: type[Backbone]) -> None:
    first, second, image = kind().eval(), kind().eval(), torch.rand(1, 3, *SIZE)
    second.load_state_dict(first.state_dict())
    for stride, features in first(image).items():
        if not torch.equal(features, second(image)[stride]):
            raise ValueError(f"stride {stride} differs after the state was copied")


BACKBONE_CHECKS: dict[str, Callable[[type[Backbone]], None]] = {
    "features as declared": _features,
    "every parameter trains": _every_parameter_trains,
    "state round trip": _backbone_round_trip,
}
