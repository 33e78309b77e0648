"""OpenVINO on the CPU, in the precision that was asked for and no other.

Source: the package openvino; the graph is an ONNX file in float32. Its own default on a CPU with
AMX is bf16, which is not what "fp32" means.
"""

import torch
from torch import Tensor, nn

from mtl_bench.core.engine import Setting
from mtl_bench.deploy.export import strided_file
from mtl_bench.deploy.graph import GraphEngine

HINTS = {"fp32": "f32", "bf16": "bf16", "fp16": "f16"}


class OpenVino(GraphEngine):
    precisions = {"cpu": ("fp32", "bf16", "fp16")}
    packages = ("openvino", "onnx", "onnxscript")
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
            compiled = core.compile_model(core.read_model(path), "CPU", options)
        chosen = compiled.get_property("INFERENCE_PRECISION_HINT").to_string()
        if chosen != hint:
            raise ValueError(
                f"OpenVINO computes in {chosen} on this CPU, not in {setting.precision}"
            )
        self.request = compiled.create_infer_request()

    def strided(self, image: Tensor) -> dict[str, Tensor]:
        found = self.request.infer({"image": image.numpy()}, share_inputs=True, share_outputs=True)
        return {name: torch.from_numpy(found[n]) for n, name in enumerate(self.names)}
