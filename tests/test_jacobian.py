"""Gradients as autograd made them give what their matrix would."""

import pytest
import torch

from mtl_bench.train.gramian import CPU_CHUNK, add, combine, divided, flatten, products, unflatten

SHAPES = [(3, 4), (CPU_CHUNK + 5,), (2 * CPU_CHUNK,), (1,)]
LIKE = [torch.empty(shape) for shape in SHAPES]


def rows(count, seed, holes=()):
    """Gradients, zero where `holes` says (row, tensor)."""
    draw = torch.Generator().manual_seed(seed)
    made = [[torch.randn(shape, generator=draw) for shape in SHAPES] for _ in range(count)]
    for row, index in holes:
        made[row][index] = None
    return made


def matrix(gradients):
    return torch.stack([flatten(row, LIKE) for row in gradients]).double()


@pytest.mark.parametrize("holes", [(), ((0, 1), (2, 1), (1, 3)), tuple((k, 2) for k in range(3))])
def test_products_are_the_matrix_times_itself_transposed(holes):
    one, two = rows(3, 0, holes), rows(4, 1, holes[:1])
    torch.testing.assert_close(
        products(one, one), matrix(one) @ matrix(one).T, rtol=1e-5, atol=1e-2
    )
    torch.testing.assert_close(
        products(one, two), matrix(one) @ matrix(two).T, rtol=1e-5, atol=1e-2
    )
    assert products(one, two).dtype == torch.float64


def test_gradients_that_are_all_zero_have_no_products():
    nothing = [[None] * len(SHAPES)] * 2
    assert torch.equal(products(nothing, nothing), torch.zeros(2, 2, dtype=torch.float64))
    assert combine(torch.ones(2), nothing) == [None] * len(SHAPES)


def test_a_weighted_sum_is_the_matrix_times_the_weights():
    weight_K, given = torch.tensor([0.5, -2.0, 3.0]), rows(3, 2, ((0, 0), (1, 0), (2, 1)))
    before = matrix(given)
    found = flatten(combine(weight_K, given), LIKE)
    torch.testing.assert_close(found, weight_K @ before.float())
    assert torch.equal(matrix(given), before)  # which stays as it is


def test_vectors_and_tensors_are_each_others_inverse():
    (row,) = rows(1, 3)
    for back, tensor in zip(unflatten(flatten(row, LIKE), LIKE), row, strict=True):
        assert torch.equal(back, tensor)


def test_sums_and_means_leave_zeros_out():
    one, two = rows(2, 4, ((0, 0), (1, 1), (0, 3), (1, 3)))
    total = add(one, two)
    assert total[0] is two[0]
    assert total[1] is one[1]
    assert torch.equal(total[2], one[2] + two[2])
    assert total[3] is None
    assert torch.equal(divided(total, 2)[2], total[2] / 2)
