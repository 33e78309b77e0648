"""Adam for the few numbers that a method itself learns, with its state in buffers.

Source: Kingma, Ba, Adam: A Method for Stochastic Optimization, ICLR 2015, arXiv:1412.6980,
algorithm 1; weight decay is added to the gradient, as in torch.optim.Adam, which it equals. It is
for methods that are moved by another gradient than that of the scalar they minimise; a module of
such a method, it travels in checkpoints and follows `.to(device)`.
"""

import torch
from torch import Tensor, nn


class Adam(nn.Module):
    """x - lr m / (sqrt(v) + eps), with m and v the bias-corrected moments of the gradient.

    Args:
        like: a tensor of the shape, type and device of what is learned.
        lr, betas, eps: step size, decay of the two moments, and what keeps the division finite.
        weight_decay: this times x is added to the gradient.
    """

    first: Tensor
    second: Tensor
    count: Tensor

    def __init__(
        self,
        like: Tensor,
        lr: float,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-8,
        weight_decay: float = 0.0,
    ):
        super().__init__()
        self.lr, self.betas, self.eps, self.weight_decay = lr, betas, eps, weight_decay
        self.register_buffer("first", torch.zeros_like(like))
        self.register_buffer("second", torch.zeros_like(like))
        self.register_buffer("count", torch.zeros_like(like, dtype=torch.int64))

    @torch.no_grad()
    def step(self, value: Tensor, grad: Tensor, at: Tensor | slice = slice(None)) -> Tensor:
        """The new value; each element counts its own steps.

        Args:
            value, grad: of the shape of `like`, or of `like[at]`.
            at: indices of the elements that move; the moments of the others stay as they are.
        """
        grad = grad + self.weight_decay * value
        beta, beta_square = self.betas
        self.count[at] += 1
        self.first[at] = beta * self.first[at] + (1 - beta) * grad
        self.second[at] = beta_square * self.second[at] + (1 - beta_square) * grad**2
        count = self.count[at].double()  # 1 - 0.999 in single precision is off by 5e-5 of itself
        mean = self.first[at] / (1 - beta**count).to(grad)
        spread = self.second[at] / (1 - beta_square**count).to(grad)
        return value - self.lr * mean / (spread.sqrt() + self.eps)
