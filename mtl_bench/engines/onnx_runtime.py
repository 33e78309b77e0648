"""ONNX Runtime on the CPU."""

import tempfile
from pathlib import Path

import torch
from torch import Tensor, nn

from mtl_bench.engines import onnx_file
from mtl_bench.engines.base import Setting, StridedEngine
from mtl_bench.engines.graph import strided


class OnnxRuntime(StridedEngine):
    package = "onnxruntime"

    def __init__(self, net: nn.Module, setting: Setting):
        super().__init__(net, setting)
        import onnxruntime

        with tempfile.TemporaryDirectory() as folder:
            path, self.names = write_strided(net, setting, Path(folder))
            options = onnxruntime.SessionOptions()
            options.intra_op_num_threads = setting.threads
            self.session = onnxruntime.InferenceSession(
                str(path), options, providers=["CPUExecutionProvider"]
            )

    def strided(self, image: Tensor) -> dict[str, Tensor]:
        found = self.session.run(self.names, {"image": image.numpy()})
        return {
            name: torch.from_numpy(array) for name, array in zip(self.names, found, strict=True)
        }


def write_strided(net: nn.Module, setting: Setting, folder: Path) -> tuple[Path, list[str]]:
    """The strided graph as an ONNX file in float32; its path and the names of its outputs."""
    graph = strided(net, (setting.batch, *setting.size))
    image_BHW3 = torch.zeros(
        setting.batch, *setting.size, 3, dtype=torch.uint8, device=setting.device
    )
    path = folder / "strided.onnx"
    onnx_file.write(graph, {"image": image_BHW3}, graph.names, path)
    return path, graph.names
