"""Batch normalisation folded into the convolution before it, whatever modules they come from.

A batch normalisation at inference is a factor and a shift a channel; the convolution's weights and
bias take them in. On the graph of operators that torch.export records, not on modules: the order of
modules says nothing about who reads what, and timm's norm-and-activation layers call functions.
"""

import copy
from typing import Any

import torch
from torch import Tensor, fx, nn

CONVOLUTIONS = (torch.ops.aten.conv2d.default, torch.ops.aten.conv2d.padding)
NORM = torch.ops.aten.batch_norm.default
CHECK = torch.ops.aten._assert_tensor_metadata.default  # of dtypes, which engines change


def fold(module: nn.Module, example: Tensor) -> fx.GraphModule:
    """The module's graph for inputs of the example's size, with weights of its own.

    Args:
        module: in evaluation mode.
    """
    with torch.no_grad():
        program = torch.export.export(copy.deepcopy(module), (example,), strict=False).module()
        assert isinstance(program, fx.GraphModule)
        _erase(program, CHECK)
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
    value: Any = program
    for name in node.target.split("."):
        value = getattr(value, name)
    found: Tensor = value.detach()
    return found


def _erase(program: fx.GraphModule, target: Any) -> None:
    for node in list(program.graph.nodes):
        if node.target is target:
            program.graph.erase_node(node)
