"""The multi-task network and what surrounds it; see `network.py` for the whole picture."""

from mtl_bench.model.network import Model, Outputs, build_model, side_by_side

__all__ = ["Model", "Outputs", "build_model", "side_by_side"]
