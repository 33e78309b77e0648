"""Networks that were each trained alone on one task, side by side as one."""

from collections.abc import Iterable

from torch import Tensor, nn

from mtl_bench.model.network import Model, Network, Outputs


class SingleTaskNetworks(nn.Module):
    """What runs at inference: every network on the same image, one after another."""

    def __init__(self, networks: Iterable[Network]):
        super().__init__()
        self.networks = nn.ModuleList(networks)

    def forward(self, image_B3HW: Tensor) -> Outputs:
        merged = Outputs()
        for network in self.networks:
            outputs = network(image_B3HW)
            if outputs.semantic_BCHW is not None:
                merged.semantic_BCHW = outputs.semantic_BCHW
                merged.center_B1HW = outputs.center_B1HW
                merged.offset_B2HW = outputs.offset_B2HW
            merged.inverse_depth += outputs.inverse_depth
        return merged


def side_by_side(models: Iterable[Model]) -> Model:
    """One model to evaluate and to time; it shares nothing and is not trained."""
    return Model(SingleTaskNetworks(model.net for model in models), None)  # type: ignore[arg-type]
