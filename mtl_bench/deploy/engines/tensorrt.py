"""TensorRT on CUDA, from an ONNX file; its buffers are torch's, so nothing leaves the device.

Source: TensorRT 10's documentation; it has not run on a GPU yet.
"""

from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from mtl_bench.core.engine import Setting
from mtl_bench.deploy.export import strided_file
from mtl_bench.deploy.graph import GraphEngine

FLAGS = {"fp32": (), "bf16": ("BF16",), "fp16": ("FP16",)}


class TensorRt(GraphEngine):
    precisions = {"cuda": ("fp32", "bf16", "fp16")}
    packages = ("tensorrt", "onnx", "onnxscript")
    extra = ("mtl-bench[onnx]", "tensorrt")

    @classmethod
    def lack(cls) -> str | None:
        gpu = torch.cuda.is_available()
        lacking = None if gpu else "needs an NVIDIA GPU, and torch sees no CUDA device here"
        return super().lack() or lacking

    def build(self, net: nn.Module, setting: Setting) -> None:
        import tensorrt

        logger = tensorrt.Logger(tensorrt.Logger.ERROR)
        with strided_file(net, setting) as (path, self.names):
            plan = _plan(tensorrt, logger, path, setting.precision)
        self._engine = tensorrt.Runtime(logger).deserialize_cuda_engine(plan)
        self._context = self._engine.create_execution_context()
        self._stream = torch.cuda.Stream(setting.device)
        self._out = {}
        for name in self.names:
            shape = tuple(self._engine.get_tensor_shape(name))
            self._out[name] = torch.empty(shape, device=setting.device)
            self._context.set_tensor_address(name, self._out[name].data_ptr())

    def strided(self, image: Tensor) -> dict[str, Tensor]:
        current = torch.cuda.current_stream(self.setting.device)
        self._stream.wait_stream(current)
        self._context.set_tensor_address("image", image.data_ptr())
        self._context.execute_async_v3(self._stream.cuda_stream)
        current.wait_stream(self._stream)
        return self._out


def _plan(tensorrt: Any, logger: Any, path: Path, precision: str) -> Any:
    """The engine as TensorRT writes it.

    Raises:
        ValueError: TensorRT cannot read the graph or build it.
    """
    builder = tensorrt.Builder(logger)
    network = builder.create_network(0)
    parser = tensorrt.OnnxParser(network, logger)
    if not parser.parse(path.read_bytes()):
        raise ValueError(f"TensorRT cannot read the graph: {parser.get_error(0)}")
    config = builder.create_builder_config()
    config.clear_flag(tensorrt.BuilderFlag.TF32)
    for flag in FLAGS[precision]:
        config.set_flag(getattr(tensorrt.BuilderFlag, flag))
    plan = builder.build_serialized_network(network, config)
    if plan is None:
        raise ValueError(f"TensorRT cannot build the graph in {precision}")
    return plan
