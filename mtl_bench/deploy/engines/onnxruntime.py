"""ONNX Runtime on the CPU.

Source: the package onnxruntime; the graph is an ONNX file in float32.
"""

import torch
from torch import Tensor, nn

from mtl_bench.core.engine import Setting
from mtl_bench.deploy.export import strided_file
from mtl_bench.deploy.graph import GraphEngine


class OnnxRuntime(GraphEngine):
    precisions = {"cpu": ("fp32",)}
    packages = ("onnxruntime", "onnx", "onnxscript")
    extra = ("mtl-bench[onnx]",)

    def build(self, net: nn.Module, setting: Setting) -> None:
        import onnxruntime

        with strided_file(net, setting) as (path, self.names):
            options = onnxruntime.SessionOptions()
            options.intra_op_num_threads = setting.threads
            self.session = onnxruntime.InferenceSession(
                str(path), options, providers=["CPUExecutionProvider"]
            )

    def strided(self, image: Tensor) -> dict[str, Tensor]:
        found = self.session.run(self.names, {"image": image.numpy()})
        return dict(zip(self.names, map(torch.from_numpy, found), strict=True))
