"""Small problems on a Gramian, exact for every one that gradients can have.

All work on the correlation matrix C = G_ij / (|g_i| |g_j|): tasks of any scale look alike there,
and float32 gradients leave rounding of about 1e-7 in it whatever the scales are. In C the row of a
zero gradient is zero: such a task takes no part, unless a solver says otherwise.

A solve that fails raises `ArithmeticError` with its matrix; nothing falls back to other weights.

Shapes: K tasks. Everything is float64 on the CPU.
"""

import torch
from scipy.optimize import nnls
from torch import Tensor

ROUNDING = 1e-6  # smaller eigenvalues of a correlation matrix are rounding of float32 gradients


def failure(what: str, matrix: Tensor) -> ArithmeticError:
    """The error to raise, with the matrix to reproduce it."""
    return ArithmeticError(f"{what}; the matrix was {matrix.tolist()}")


def finite(G_KK: Tensor) -> Tensor:
    """The Gramian, if all of it is finite.

    Raises:
        ArithmeticError: an entry is not.
    """
    if not torch.isfinite(G_KK).all():
        raise failure("the Gramian is not finite", G_KK)
    return G_KK


def correlation(G_KK: Tensor) -> tuple[Tensor, Tensor]:
    """Norms [K], 1 where the gradient is zero, and the correlation matrix, with zero rows there."""
    present_K = finite(G_KK).diagonal() > 0
    norm_K = torch.where(present_K, G_KK.diagonal(), 1.0).sqrt()
    C_KK = G_KK / norm_K / norm_K[:, None]
    return norm_K, torch.where(present_K & present_K[:, None], C_KK, 0.0)


def pseudo_inverse(C_KK: Tensor) -> Tensor:
    """Of a correlation matrix: directions within rounding of zero are left out."""
    eigenvalue_K, V_KK = torch.linalg.eigh(C_KK)
    inverse_K = torch.where(eigenvalue_K > ROUNDING, 1 / eigenvalue_K, 0.0)
    found: Tensor = (V_KK * inverse_K) @ V_KK.T
    return found


def equal_projections(C_KK: Tensor) -> Tensor:
    """Weights of unit gradients whose sum has the product 1 with each, or as near as possible.

    0 where the gradients cancel, so that nothing has a like product with all of them.
    """
    weight_K = pseudo_inverse(C_KK).sum(1)
    return weight_K if weight_K.sum() > ROUNDING else torch.zeros_like(weight_K)


def root(G_KK: Tensor) -> Tensor:
    """R with R^T R = G, accurate in every column however different the norms are."""
    norm_K, C_KK = correlation(G_KK)
    eigenvalue_K, V_KK = torch.linalg.eigh(C_KK)
    found: Tensor = eigenvalue_K.clamp_min(0).sqrt()[:, None] * V_KK.T * norm_K
    return found


def least_squares(A_NK: Tensor, b_N: Tensor) -> Tensor:
    """argmin |A x - b| over x >= 0."""
    try:
        x_K, _ = nnls(A_NK.numpy(), b_N.numpy(), maxiter=100 * len(A_NK.T))
    except RuntimeError as error:
        raise failure(f"non-negative least squares: {error}", A_NK) from error
    return torch.from_numpy(x_K)


def min_norm(G_KK: Tensor) -> Tensor:
    """argmin w^T G w over the simplex: weights of the shortest convex combination.

    The x >= 0 that minimises x^T G x + (1 - sum x)^2 points along them: both have (G x)_i equal
    where x_i > 0, and no smaller where x_i = 0. The answer is no longer than the shortest
    gradient, so that one sets the scale.
    """
    square_K = finite(G_KK).diagonal()
    R_KK = root(G_KK / square_K[square_K > 0].min()) if square_K.any() else G_KK
    A_LK = torch.cat([R_KK, torch.ones(1, len(G_KK), dtype=G_KK.dtype)])
    x_K = least_squares(A_LK, torch.eye(len(A_LK), dtype=G_KK.dtype)[-1])
    return x_K / x_K.sum()


def project_on_dual_cone(G_KK: Tensor, weight_NK: Tensor) -> Tensor:
    """For each of N w, argmin v^T G v over v >= w: nearest to J^T w of what no gradient opposes."""
    R_KK = root(G_KK)
    more_NK = [least_squares(R_KK, -R_KK @ weight_K) for weight_K in weight_NK]
    return weight_NK + torch.stack(more_NK)


def regularized(G_KK: Tensor, epsilon: float) -> Tensor:
    """G / tr G + epsilon I; a zero Gramian stays zero but for epsilon."""
    trace = finite(G_KK).trace()
    scaled_KK = G_KK / trace if trace > 0 else G_KK
    return scaled_KK + epsilon * torch.eye(len(G_KK), dtype=G_KK.dtype)


def project_on_simplex(v_K: Tensor) -> Tensor:
    """The nearest point with entries >= 0 that sum to 1."""
    v_K = v_K - v_K.max()  # the answer is the same, and exact far away from the simplex
    sorted_K = v_K.sort(descending=True).values
    rank_K = torch.arange(1, len(v_K) + 1, dtype=v_K.dtype)
    shift_K = (sorted_K.cumsum(0) - 1) / rank_K  # were only the largest 1, 2, ... entries positive
    return (v_K - shift_K[sorted_K > shift_K][-1]).clamp_min(0)


def descend(weight_K: Tensor, step_K: Tensor) -> Tensor:
    """The nearest weights >= 0 to `weight - step` that have the same sum as before.

    The sum is 1, less what tasks without labels in this batch have and keep.
    """
    sum_ = weight_K.sum().clamp_min(1e-12)  # 0 if absent tasks have everything
    moved_K = (weight_K - step_K) / sum_
    return sum_ * project_on_simplex(moved_K - moved_K.max())  # the same point, exact when far away


def fair(G_KK: Tensor, power: float) -> Tensor:
    """w > 0 with (G w)_i = w_i^-power, by damped Newton; 1 where the gradient is zero.

    With x_i = |g_i| w_i it is the minimum of a convex function, x^T C x / 2 - sum_i b_i phi(x_i),
    phi' = x^-power, b_i = |g_i|^(power-1). Where no direction helps every task (g and -g) there is
    none; eigenvalues of C are raised to their rounding, which bounds the weights.

    Raises:
        ArithmeticError: no convergence.
    """
    norm_K, C_KK = correlation(G_KK)
    eigenvalue_K, V_KK = torch.linalg.eigh(C_KK + torch.diag(1 - C_KK.diagonal()))
    C_KK = (V_KK * eigenvalue_K.clamp_min(ROUNDING)) @ V_KK.T
    b_K = norm_K ** (power - 1)
    x_K = b_K ** (1 / (1 + power))  # the answer for orthogonal gradients
    gain = float("inf")
    for _ in range(200):
        pull_K, push_K = x_K * (C_KK @ x_K), b_K * x_K ** (1 - power)
        H_KK = C_KK * x_K * x_K[:, None] + torch.diag(power * push_K)
        step_K = torch.linalg.solve(H_KK, push_K - pull_K)  # relative to x
        before, gain = gain, float(step_K @ (push_K - pull_K))
        if before / 4 <= gain <= 1e-16 * push_K.sum():  # only rounding is left
            return x_K / norm_K
        x_K = x_K * (1 + _damped(C_KK, b_K, power, x_K, step_K))
    raise failure(f"no w with (G w)_i = w_i^-{power:g} found", G_KK)


def _damped(C_KK: Tensor, b_K: Tensor, power: float, x_K: Tensor, step_K: Tensor) -> Tensor:
    """A part of the step that keeps x positive and does not overshoot."""

    def slope(size: float) -> float:  # of the convex function along the step; negative at 0
        y_K = x_K * (1 + size * step_K)
        return float((x_K * step_K) @ (C_KK @ y_K - b_K * y_K**-power))

    size, steepest = min(1.0, 0.9 / max(0.9, float(-step_K.min()))), abs(slope(0.0))
    while step_K.abs().max() > 1e-3 and slope(size) > 0.5 * steepest and size > 1e-9:
        size /= 2
    return size * step_K


def shortest_above(R_LK: Tensor, height_K: Tensor) -> Tensor | None:
    """x >= 0 of the shortest R x with R^T R x >= height; None where there is no such vector.

    Lawson, Hanson, Solving Least Squares Problems, 1974, chapter 23: least-distance programming
    is non-negative least squares with one more row.
    """
    A_LK = torch.cat([R_LK, height_K[None]])
    x_K = least_squares(A_LK, torch.eye(len(A_LK), dtype=R_LK.dtype)[-1])
    rest = 1 - height_K @ x_K
    return x_K / rest if rest > 1e-12 else None
