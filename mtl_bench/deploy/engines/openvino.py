"""OpenVINO on the CPU, in the precision that was asked for and no other.

Source: the package openvino; the graph is an ONNX file in float32. Its own default on a CPU with
AMX is bf16, which is not what "fp32" means. In int8, weights and maps are whole numbers whose
ranges the package nncf finds on images of the training split, with nothing trained again.
"""

import contextlib
import io
import logging
import os
from typing import Any

import torch
from torch import Tensor, nn

from mtl_bench.core.engine import Setting
from mtl_bench.deploy.export import strided_file
from mtl_bench.deploy.graph import GraphEngine

HINTS = {"fp32": "f32", "bf16": "bf16", "fp16": "f16", "int8": "f32"}  # int8: of the rest


class OpenVino(GraphEngine):
    precisions = {"cpu": ("fp32", "bf16", "fp16", "int8")}
    packages = ("openvino", "onnx", "onnxscript", "nncf")
    extra = ("mtl-bench[onnx,openvino]",)

    def build(self, net: nn.Module, setting: Setting) -> None:
        import openvino

        hint = HINTS[setting.precision]
        options = {
            "INFERENCE_PRECISION_HINT": hint,
            "PERFORMANCE_HINT": "LATENCY",
            "INFERENCE_NUM_THREADS": setting.threads,
        }
        with strided_file(net, setting) as (path, self.names):
            core = openvino.Core()
            model = core.read_model(path)
            if setting.precision == "int8":
                model = _quantised(model, setting)
            compiled = core.compile_model(model, "CPU", options)
        chosen = compiled.get_property("INFERENCE_PRECISION_HINT").to_string()
        if chosen != hint:
            raise ValueError(
                f"OpenVINO computes in {chosen} on this CPU, not in {setting.precision}"
            )
        self.request = compiled.create_infer_request()

    def strided(self, image: Tensor) -> dict[str, Tensor]:
        found = self.request.infer({"image": image.numpy()}, share_inputs=True, share_outputs=True)
        return {name: torch.from_numpy(found[n]) for n, name in enumerate(self.names)}


def _quantised(model: Any, setting: Setting) -> Any:
    """Weights by channel, what a ReLU gives without a sign; of the kinds that nncf has, `MIXED`
    comes nearest to float32 (ResNet18's inverse depth of random weights: 0.09 of its deviation off,
    else 0.11).

    Raises:
        ValueError: fewer examples than images in a batch.
    """
    count = len(setting.examples) // setting.batch * setting.batch
    if not count:
        raise ValueError(
            f"int8 needs {setting.batch} images of the training split or more, and there are "
            f"{len(setting.examples)}: use another precision"
        )
    os.environ.setdefault("NNCF_CI", "1")  # else it tells its makers of each use
    import nncf

    nncf.set_log_level(logging.ERROR)
    batches = torch.cat(setting.examples[:count]).split(setting.batch)
    data = nncf.Dataset([{"image": batch_BHW3.numpy()} for batch_BHW3 in batches])
    with contextlib.redirect_stdout(io.StringIO()):  # its progress bars
        return nncf.quantize(
            model, data, preset=nncf.QuantizationPreset.MIXED, subset_size=len(batches)
        )
