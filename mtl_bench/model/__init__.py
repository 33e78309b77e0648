"""The multi-task network and what surrounds it; see `network.py` for the whole picture."""

from mtl_bench.core.backbone import Backbone, TimmBackbone
from mtl_bench.model.network import Model, Outputs, build_model
from mtl_bench.model.single_tasks import side_by_side

__all__ = ["Backbone", "Model", "Outputs", "TimmBackbone", "build_model", "side_by_side"]
