"""What runs a network fast: one class a file, all with the contract of `base.InferenceEngine`.

plain        the network as it was trained, float32: what the others are compared with
eager        torch, batch normalisation folded into the convolutions, channels last
compile      the same graph through torch.compile; on CUDA with CUDA graphs
onnxruntime  ONNX Runtime
openvino     OpenVINO
tensorrt     TensorRT, on CUDA only

`available` and `check` import nothing heavy.
"""

import importlib
import importlib.util
import os
import shutil
from typing import TYPE_CHECKING

from mtl_bench.core.plain import did_you_mean

if TYPE_CHECKING:
    from mtl_bench.engines.base import InferenceEngine

PRECISIONS: dict[str, dict[str, tuple[str, ...]]] = {  # engine -> kind of device -> precisions
    "plain": {"cpu": ("fp32",), "cuda": ("fp32",)},
    "eager": {"cpu": ("fp32", "bf16"), "cuda": ("fp32", "bf16", "fp16")},
    "compile": {"cpu": ("fp32", "bf16"), "cuda": ("fp32", "bf16", "fp16")},
    "onnxruntime": {"cpu": ("fp32",)},
    "openvino": {"cpu": ("fp32", "bf16", "fp16")},
    "tensorrt": {"cuda": ("fp32", "bf16", "fp16")},
}
NAMES = tuple(PRECISIONS)
CLASSES = {
    "plain": ("plain", "Plain"),
    "eager": ("eager", "Eager"),
    "compile": ("compiled", "Compiled"),
    "onnxruntime": ("onnx_runtime", "OnnxRuntime"),
    "openvino": ("open_vino", "OpenVino"),
    "tensorrt": ("tensor_rt", "TensorRt"),
}
_EXTRAS = {  # packages, and what installs them
    "onnxruntime": (("onnxruntime", "onnx", "onnxscript"), "mtl-bench[onnx]"),
    "openvino": (("openvino", "onnx", "onnxscript"), "mtl-bench[onnx,openvino]"),
    "tensorrt": (("tensorrt", "onnx", "onnxscript"), "mtl-bench[onnx]' 'tensorrt"),
}


def available(name: str) -> str | None:
    """None, or why the engine cannot run here and what would change that."""
    packages, extra = _EXTRAS.get(name, ((), ""))
    lacking = [package for package in packages if importlib.util.find_spec(package) is None]
    if lacking:
        return f"lacks the package {', '.join(lacking)}: pip install '{extra}'"
    if name == "tensorrt" and not _cuda():
        return "needs an NVIDIA GPU, and torch sees no CUDA device here"
    if name == "compile" and not (_compiler() or _cuda()):
        return "needs a C++ compiler: install g++, or name one in the variable CXX"
    return None


def check(name: str, precision: str, device: str) -> None:
    """An engine has this precision on this kind of device (cpu, cuda).

    Raises:
        ValueError: no such engine, or it does not; says what it has.
    """
    if name not in PRECISIONS:
        raise ValueError(f"no engine called '{name}'{did_you_mean(name, NAMES)}")
    if precision not in PRECISIONS[name].get(device, ()):
        has = "; ".join(f"{', '.join(p)} on {kind}" for kind, p in PRECISIONS[name].items())
        raise ValueError(f"engine {name} has no {precision} on {device}: it has {has}")


def load(name: str) -> "type[InferenceEngine]":
    module, kind = CLASSES[name]
    found: type[InferenceEngine] = getattr(
        importlib.import_module(f"mtl_bench.engines.{module}"), kind
    )
    return found


def _compiler() -> str | None:
    return shutil.which(os.environ.get("CXX", "g++")) or shutil.which("clang++")


def _cuda() -> bool:
    import torch

    return torch.cuda.is_available()
