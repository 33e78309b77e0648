"""The network as engines run it: 8-bit image in, maps at the finest stride out, then full size.

The network's own forward pass ends with maps of the image's size. They hold no more than the
strided ones, which are a 64th of them at stride 8; `Upsample` makes what is needed of them.
Shapes: B images, C classes, H x W input pixels, h x w cells of the finest stride, m mixed cells,
P rows or columns a cell.
"""

import copy
import operator
from abc import abstractmethod
from typing import Any

import torch
from torch import Tensor, fx, nn

from mtl_bench.core.engine import Engine, Setting
from mtl_bench.deploy import maps
from mtl_bench.deploy.maps import Maps
from mtl_bench.model.network import resize


class Body(nn.Module):
    """Normalised image -> what the last convolutions say, in `names`' order."""

    def __init__(self, net: nn.Module):
        super().__init__()
        self.networks = nn.ModuleList(maps.networks_of(net))
        self.tasks = maps.tasks_of(net)
        self.names = list(maps.infos(self.tasks))

    def forward(self, x_B3HW: Tensor) -> tuple[Tensor, ...]:
        found: dict[str, Maps] = {}
        networks: Any = self.networks
        for network in networks:
            found |= network.raw(*network.features(x_B3HW))
        return tuple(maps.flat(found, self.tasks).values())


class Strided(nn.Module):
    """Image uint8 [B,H,W,3] -> float32 maps [B,.,h,w] in the order of `names`: see `maps`.

    Args:
        body: `Body`, or its folded graph.
        net: whose constants are used; of several networks side by side the first one's, as they
            have the same backbone and recipe.
        dtype: that the body computes in.
    """

    def __init__(self, body: nn.Module, net: nn.Module, dtype: torch.dtype):
        super().__init__()
        first = maps.networks_of(net)[0]
        self.body, self.tasks, self.dtype = body, maps.tasks_of(net), dtype
        self.names = list(maps.infos(self.tasks))
        mean_311, std_311 = first.normalize.mean_311, first.normalize.std_311
        self.register_buffer("scale_311", 1 / (255 * std_311), persistent=False)
        self.register_buffer("shift_311", -mean_311 / std_311, persistent=False)
        self.scale_311: Tensor
        self.shift_311: Tensor

    def forward(self, image_BHW3: Tensor) -> tuple[Tensor, ...]:
        image_B3HW = image_BHW3.permute(0, 3, 1, 2).float() * self.scale_311 + self.shift_311
        raw = [map_.float() for map_ in self.body(image_B3HW.to(self.dtype))]
        own = maps.by_task(dict(zip(self.names, raw, strict=True)), self.tasks)
        active = {task.name: task.activate(own[task.name]) for task in self.tasks}
        return tuple(maps.flat(active, self.tasks).values())


def strided(
    net: nn.Module,
    shape: tuple[int, int, int],
    dtype: torch.dtype = torch.float32,
    multiple: int | None = None,
) -> Strided:
    """The graph of a network in evaluation mode, folded, channels last; the network stays as it is.

    Args:
        shape: B, H, W.
        dtype: of weights and activations; folding is done in float32 before.
        multiple: H and W are free, in multiples of this.

    Raises:
        ValueError: a network that is made for one size, where H and W should be free.
    """
    body = Body(net)
    device = next(net.parameters()).device
    example_B3HW = torch.zeros(shape[0], 3, *shape[1:], device=device)
    example_B3HW = example_B3HW.contiguous(memory_format=torch.channels_last)
    folded = fold(body, example_B3HW, multiple).to(dtype)
    graph = Strided(folded, net, dtype)
    for module in graph.modules():
        module.training = False  # an exported graph has no eval()
    return graph.to(memory_format=torch.channels_last)


class GraphEngine(Engine):
    """Base of engines that run the graph of `strided`: a subclass builds it and says how it runs.

    See `engines/eager.py` for one, `mtl-bench new engine NAME` for a start.
    """

    def __init__(self, net: nn.Module, setting: Setting):
        super().__init__(net, setting)
        self._infos = maps.infos(maps.tasks_of(net))
        self._upsamples: dict[torch.Size, Upsample] = {}  # by the size of the strided maps

    @abstractmethod
    def strided(self, image: Any) -> Maps:
        """Maps at the finest stride by the names of the graph."""

    def run(self, image: Any) -> Maps:
        large: Maps = {}
        for name, map_ in self.strided(image).items():
            classes = self._infos[name].classes
            large[name] = map_ if classes else resize(map_, self.setting.size)
            if classes:
                large[f"{name}{maps.CLASS}"] = self._classes(map_)
        return large

    def _classes(self, logits: Tensor) -> Tensor:
        """Index of the largest, of a vector [B,C] or at the image's size of maps [B,C,h,w]."""
        if logits.dim() == 2:
            return logits.argmax(1)
        small = logits.shape[2:]
        if small not in self._upsamples:
            size = (small[0], small[1])
            self._upsamples[small] = Upsample(size, self.setting.size, logits.device)
        return self._upsamples[small].classes(logits)


# --- folding --------------------------------------------------------------------------------------
# A batch normalisation at inference is a factor and a shift a channel; the weights and the bias of
# the convolution before it take them in. On the graph of operators that torch.export records, not
# on modules: the order of modules says nothing about who reads what, and timm's norm-and-activation
# layers call functions.

CONVOLUTIONS = (torch.ops.aten.conv2d.default, torch.ops.aten.conv2d.padding)
NORM = torch.ops.aten.batch_norm.default
LARGEST = 2**13  # pixels of a height or width that is free
CHECK = torch.ops.aten._assert_tensor_metadata.default  # of dtypes, which engines change


def free(multiple: int | None, height: int, width: int) -> dict[int, Any] | None:
    """Axes of these numbers that are multiples of one number, for `torch.export`; None: fixed."""
    if multiple is None:
        return None
    most = LARGEST // multiple
    axes = {
        height: torch.export.Dim("height", max=most),
        width: torch.export.Dim("width", max=most),
    }
    return {axis: multiple * dim for axis, dim in axes.items()}


def fold(module: nn.Module, example: Tensor, multiple: int | None = None) -> fx.GraphModule:
    """The module's graph for inputs of the example's size, with weights of its own.

    Args:
        module: in evaluation mode.
        multiple: as in `strided`.
    """
    with torch.no_grad():
        sizes = free(multiple, 2, 3)
        try:
            exported = torch.export.export(
                copy.deepcopy(module), (example,), dynamic_shapes=sizes and (sizes,), strict=False
            )
        except Exception as error:
            if multiple is None:
                raise
            why = str(error).strip().partition("\n")[0]
            raise ValueError(
                f"this network is made for one size: leave out --dynamic ({why})"
            ) from error
        program = exported.module()
        assert isinstance(program, fx.GraphModule)
        for check in program.graph.find_nodes(op="call_function", target=CHECK):
            program.graph.erase_node(check)
        for number, node in enumerate(list(program.graph.nodes)):
            if node.target is NORM and _only_reads_a_convolution(node):
                _fold_one(program, node, number)
    program.graph.eliminate_dead_code()
    program.delete_all_unused_submodules()
    program.recompile()
    return program


def _only_reads_a_convolution(norm: fx.Node) -> bool:
    source = norm.args[0]
    return isinstance(source, fx.Node) and source.target in CONVOLUTIONS and len(source.users) == 1


def _fold_one(program: fx.GraphModule, norm: fx.Node, number: int) -> None:
    """Args of batch_norm: input, weight, bias, mean, variance, training, momentum, eps."""
    convolution: Any = norm.args[0]
    weight, bias = (_tensor(program, arg) for arg in (*convolution.args, None)[1:3])
    gamma, beta, mean, variance = (_tensor(program, arg) for arg in norm.args[1:5])
    assert weight is not None
    assert mean is not None
    assert variance is not None
    eps: Any = norm.args[7]
    factor = (variance + eps).rsqrt()
    if gamma is not None:
        factor = factor * gamma
    shift = (0 if bias is None else bias) - mean
    shift = shift * factor + (0 if beta is None else beta)
    names = (f"folded_weight_{number}", f"folded_bias_{number}")
    program.register_buffer(names[0], weight * factor.view(-1, 1, 1, 1))
    program.register_buffer(names[1], shift)
    with program.graph.inserting_before(convolution):
        new = [program.graph.get_attr(name) for name in names]
    convolution.args = (convolution.args[0], *new, *convolution.args[3:])
    norm.replace_all_uses_with(convolution)
    program.graph.erase_node(norm)


def _tensor(program: fx.GraphModule, node: Any) -> Tensor | None:
    """The value of a graph's weight."""
    if node is None:
        return None
    found: Tensor = operator.attrgetter(node.target)(program).detach()
    return found


# --- to the size of the image -------------------------------------------------------------------

CHUNK = 2**19  # logits held at once: what a core's cache holds


class Upsample:
    """From maps at the finest stride to the image's size, where most of the pixels are cheap.

    Bilinear with aligned corners, as in the network. Twenty full-size maps of logits are written
    and read again only to find each pixel's largest: at 1024x2048 that takes longer than the
    network does in bf16. Here a cell is the image between four neighbouring logits. A class that is
    largest at all four corners is largest in between, as every pixel is a weighted mean of them
    with positive weights; only cells whose corners differ are interpolated.

    Args:
        small: h, w of the maps, each 2 or more.
        large: H, W of the image, not smaller.
    """

    def __init__(self, small: tuple[int, int], large: tuple[int, int], device: torch.device):
        self.size = large
        self._row_H, self._down_Ph, self._fy_Ph = _axis(small[0], large[0], device)
        self._column_W, self._right_Pw, self._fx_Pw = _axis(small[1], large[1], device)

    def classes(self, logits_BChw: Tensor) -> Tensor:
        """Index [B,H,W] (uint8) of the largest of the interpolated logits; of equals the first."""
        if logits_BChw.device.type == "cuda":  # has the bandwidth, and would wait for the host
            return resize(logits_BChw, self.size).argmax(1).to(torch.uint8)
        return torch.stack([self._classes(logits_Chw) for logits_Chw in logits_BChw.float()])

    def _classes(self, logits_Chw: Tensor) -> Tensor:
        logits_Chw = logits_Chw.contiguous()
        best_hw = _first_largest(logits_Chw)
        corner = best_hw[:-1, :-1]
        mixed = (corner != best_hw[1:, :-1]) | (corner != best_hw[:-1, 1:])
        mixed |= corner != best_hw[1:, 1:]
        result_HW = corner.index_select(1, self._column_W).index_select(0, self._row_H)
        flat_N = result_HW.view(-1)
        i_M, j_M = mixed.nonzero(as_tuple=True)
        step = max(CHUNK // (len(logits_Chw) * len(self._fy_Ph) * len(self._fx_Pw)), 1)
        for i_m, j_m in zip(i_M.split(step), j_M.split(step), strict=True):
            class_PPm = _first_largest(self._cells(logits_Chw, i_m, j_m))
            row_P1m, column_Pm = self._down_Ph[:, None, i_m], self._right_Pw[:, j_m]
            at_PPm = row_P1m * self.size[1] + column_Pm
            flat_N.scatter_(0, at_PPm.flatten(), class_PPm.flatten())
        return result_HW

    def _cells(self, logits_Chw: Tensor, i_m: Tensor, j_m: Tensor) -> Tensor:
        """Logits [C,P,P,m] of all pixels of cells; cells last, so that every step is vectorised."""
        flat_CN, width = logits_Chw.flatten(1), logits_Chw.shape[2]
        at_m = i_m * width + j_m
        fx_Pm, fy_P1m = self._fx_Pw[:, j_m], self._fy_Ph[:, None, i_m]

        def along_x(start_m: Tensor) -> Tensor:
            left_C11m = flat_CN.index_select(1, start_m)[:, None, None]
            right_C11m = flat_CN.index_select(1, start_m + 1)[:, None, None]
            return left_C11m * (1 - fx_Pm) + right_C11m * fx_Pm

        upper_C1Pm, lower_C1Pm = along_x(at_m), along_x(at_m + width)
        return (upper_C1Pm * (1 - fy_P1m)).addcmul_(lower_C1Pm, fy_P1m)


def _axis(few: int, many: int, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """Of one axis: each pixel's cell [many]; each cell's pixels [P,few-1], and how far each is from
    the cell's start to its end. Cells of fewer than P pixels name their last one again."""
    position = torch.arange(many, dtype=torch.float32) * ((few - 1) / max(many - 1, 1))
    cell = position.long().clamp(max=few - 2)
    count = torch.bincount(cell, minlength=few - 1)
    first = count.cumsum(0) - count
    place = torch.arange(int(count.max()))[:, None].minimum((count - 1).clamp(min=0))
    pixel = first + place
    fraction = position[pixel] - torch.arange(few - 1)
    return cell.to(device), pixel.to(device), fraction.to(device)


def _first_largest(x_C: Tensor) -> Tensor:
    """Index (uint8) of the first largest along the first axis: one pass, vectorised on the CPU."""
    best, index = x_C[0].clone(), torch.zeros_like(x_C[0], dtype=torch.uint8)
    for number, candidate in enumerate(x_C[1:], 1):
        index.masked_fill_(candidate > best, number)
        torch.maximum(best, candidate, out=best)
    return index
