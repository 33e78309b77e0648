"""OpenVINO on the CPU, in the precision that was asked for and no other.

Its own default on a CPU with AMX is bf16, which is not what "fp32" means.
"""

import tempfile
from pathlib import Path

import torch
from torch import Tensor, nn

from mtl_bench.engines.base import Setting, StridedEngine
from mtl_bench.engines.onnx_runtime import write_strided

HINTS = {"fp32": "f32", "bf16": "bf16", "fp16": "f16"}


class OpenVino(StridedEngine):
    """Raises:
    ValueError: this CPU does not compute in the precision.
    """

    package = "openvino"

    def __init__(self, net: nn.Module, setting: Setting):
        super().__init__(net, setting)
        import openvino

        hint = HINTS[setting.precision]
        options = {
            "INFERENCE_PRECISION_HINT": hint,
            "PERFORMANCE_HINT": "LATENCY",
            "INFERENCE_NUM_THREADS": setting.threads,
        }
        with tempfile.TemporaryDirectory() as folder:
            path, self.names = write_strided(net, setting, Path(folder))
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
        arrays = (found[number] for number in range(len(self.names)))
        return {
            name: torch.from_numpy(array) for name, array in zip(self.names, arrays, strict=True)
        }
