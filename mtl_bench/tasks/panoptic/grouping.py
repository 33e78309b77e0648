"""Which center is nearest to each of many points, exactly, without a table of points x centers.

The regions of two centers meet in a line, so over a rectangle the difference of two squared
distances is linear: a center that is farther than another one at all corners is farther everywhere
inside. Cells of a grid list the centers that may be nearest somewhere in them (Voronoi regions are
convex: mostly that is one); then each point compares the few of its cell, one after the other.
Distances are float32 as a plain loop computes them, and what rounding could turn stays in the
lists, so results are the plain loop's, ties included.

The cells are fine where the centers are and grow outwards, ring by ring. The same lines run on the
CPU, on CUDA and in an exported graph, without a loop over centers or images.
Shapes: B images, K centers of an image, N points of all images, M cells of an image, L entries of
all lists, U points whose cell leaves a choice, A of them whose list is not over.
"""

import itertools
import math

import torch
from torch import Tensor

from mtl_bench.tasks.panoptic import pixels

CELLS = 2**11  # as many cover an image whose centers are all over it
RINGS = 5  # each of RING x RING cells, GROWTH times as wide as the last one's
RING, GROWTH = 16, 8
FINER = 7  # halvings of the cells' side, for centers that are all in one place
ROUNDING = 4e-6  # relative to squared distances: 64 units in the last place, twice the worst case
FAR = 1e9  # where centers that are none are: finite, so that no difference is NaN
STAGES = (4, 32, 256, 2048)  # lists are worked off up to these lengths

Level = tuple[Tensor, Tensor, int, int]  # side of its cells, first row and column, rows, columns


def nearest(
    point_2N: Tensor, image_N: Tensor, centers_BK2: Tensor, count_B: Tensor, size: tuple[int, int]
) -> Tensor:
    """Index [N] of the center nearest to each point; of equally near ones the first.

    Args:
        point_2N: (y, x), float32.
        image_N: whose centers count, int64.
        centers_BK2: (y, x), at least one a row; what follows the first `count` of a row is ignored.
        count_B: centers of each image; points of an image without any get some index below K.
        size: height and width of the images.
    """
    K = centers_BK2.shape[1]
    is_center_BK1 = (torch.arange(K, device=count_B.device) < count_B[:, None])[:, :, None]
    levels = _levels(centers_BK2, is_center_BK1, size)
    center_BK2 = torch.where(is_center_BK1, centers_BK2, FAR)
    only_M, length_M, entry_L = _candidates(center_BK2, count_B, levels)
    cell_N = _cells(point_2N, levels) + image_N * (len(only_M) // len(centers_BK2))

    nearest_N = only_M.index_select(0, cell_N)
    open_U = (nearest_N < 0).nonzero()[:, 0]
    cell_U = cell_N.index_select(0, open_U)
    place_U = _closest(
        point_2N.index_select(1, open_U),
        (length_M.cumsum(0) - length_M).index_select(0, cell_U),
        length_M.index_select(0, cell_U),
        center_BK2.view(-1, 2).index_select(0, entry_L).T.contiguous(),
        K,
    )
    return nearest_N.scatter(0, open_U, entry_L.index_select(0, place_U) % K)


def _levels(centers_BK2: Tensor, is_center_BK1: Tensor, size: tuple[int, int]) -> list[Level]:
    """The grid that covers the centers, and rings around its middle.

    Sides are powers of two: dividing by them is exact, so no point is off its cell by rounding.
    """
    largest = 2 ** max(math.ceil(math.log2(size[0] * size[1] / CELLS) / 2), 0)
    rows, columns = (math.ceil(length / largest) + 3 for length in size)
    side_S1 = centers_BK2.new_tensor([largest / 2**n for n in range(FINER + 1)])[:, None]
    room_2 = centers_BK2.new_tensor([rows - 2, columns - 2])
    low_2 = torch.where(is_center_BK1, centers_BK2, FAR).amin((0, 1))
    high_2 = torch.where(is_center_BK1, centers_BK2, -FAR).amax((0, 1))
    fits_S = ((high_2 / side_S1).floor() - (low_2 / side_S1).floor() < room_2).all(1)
    side = side_S1.index_select(0, fits_S.sum(0, keepdim=True).clamp(1, FINER + 1) - 1)[0, 0]
    first_2, last_2 = (low_2 / side).floor(), (high_2 / side).floor()
    first_2 = first_2 - ((room_2 + 1 - last_2 + first_2) / 2).floor()  # as much room on either side
    levels: list[Level] = [(side, first_2, rows, columns)]
    for n in range(RINGS):
        wide = side * (RING * GROWTH**n)
        middle_2 = ((low_2 + high_2) / 2 / wide).round()
        levels.append((wide, middle_2 - RING // 2, RING, RING))
    return levels


def _cells(point_2N: Tensor, levels: list[Level]) -> Tensor:
    """Cell [N] of each point, of the finest level that holds it; the last one is for the rest."""

    def within(level: Level, point_2P: Tensor) -> tuple[Tensor, Tensor]:
        side, first_2, rows, columns = level
        cell_2P = (point_2P / side).floor() - first_2[:, None]
        row_P, column_P = cell_2P[0], cell_2P[1]
        inside_P = (row_P >= 0) & (row_P < rows) & (column_P >= 0) & (column_P < columns)
        return inside_P, row_P * columns + column_P

    inside_N, cell_N = within(levels[0], point_2N)
    outside_O = (~inside_N).nonzero()[:, 0]
    point_2O = point_2N.index_select(1, outside_O)
    start = sum(rows * columns for _, _, rows, columns in levels)
    cell_O = torch.full_like(point_2O[0], start)
    for level in reversed(levels[1:]):
        start -= level[2] * level[3]
        inside_O, number_O = within(level, point_2O)
        cell_O = torch.where(inside_O, number_O + start, cell_O)
    return cell_N.scatter(0, outside_O, cell_O).long()


def _candidates(
    center_BK2: Tensor, count_B: Tensor, levels: list[Level]
) -> tuple[Tensor, Tensor, Tensor]:
    """Of all images' cells: the only candidate or -1; how many there are; who [L], cell by cell.

    Entries are image * K + center, in the centers' order. Centers k are compared with j, the one
    nearest to the cell's middle. The difference of their squared distances is least in a corner:
    that of the middle, less side * (|dy| + |dx|) of the two centers.
    """
    images, K = center_BK2.shape[:2]

    def squared(axis: int, first: Tensor, cells: int, side: Tensor) -> Tensor:
        middle_C = (torch.arange(cells, device=side.device, dtype=side.dtype) + first + 0.5) * side
        return (middle_C[:, None] - center_BK2[:, None, :, axis]).square()

    distances = [
        squared(0, first_2[0], rows, side)[:, :, None]
        + squared(1, first_2[1], columns, side)[:, None]
        for side, first_2, rows, columns in levels
    ]
    distance_BMK = torch.cat([distance.flatten(1, 2) for distance in distances], 1)
    side_M1 = torch.cat([side.expand(rows * columns) for side, _, rows, columns in levels])[:, None]

    near_BM = distance_BMK.argmin(2)
    least_BM1 = distance_BMK.gather(2, near_BM[:, :, None]) + ROUNDING * side_M1.square()
    apart_BKK = (center_BK2[:, :, None] - center_BK2[:, None]).abs().sum(3)
    first_B1 = torch.arange(images, device=near_BM.device)[:, None] * K
    apart_BMK = apart_BKK.flatten(0, 1).index_select(0, (near_BM + first_B1).view(-1))
    apart_BMK = apart_BMK.view_as(distance_BMK)
    more = 1 / (1 - ROUNDING)
    may_BMK = distance_BMK <= torch.addcmul(least_BM1 * more, apart_BMK, side_M1 * more)
    may_BMK = torch.cat([may_BMK, may_BMK.new_ones(images, 1, K)], 1)  # far out: anyone
    near_BM = torch.cat([near_BM, near_BM.new_zeros(images, 1)], 1)

    length_BM = may_BMK.sum(2)
    several_BM = (length_BM > 1) & (count_B > 0)[:, None]
    at_L = pixels.where(may_BMK)
    entry_L = at_L // (may_BMK.shape[1] * K) * K + at_L % K
    return near_BM.masked_fill(several_BM, -1).view(-1), length_BM.view(-1), entry_L


def _closest(
    point_2U: Tensor, start_U: Tensor, length_U: Tensor, center_2L: Tensor, longest: int
) -> Tensor:
    """Place [U] in the lists of each point's nearest; points leave when their list is over."""
    best_U = torch.full_like(point_2U[0], torch.inf)
    chosen_U = start_U
    ranks = [0, *(stage for stage in STAGES if stage < longest), longest]
    for first, last in itertools.pairwise(ranks):
        active_A = (length_U > first).nonzero()[:, 0]
        state_A = (best_U.index_select(0, active_A), chosen_U.index_select(0, active_A))
        best_A, chosen_A = _compare(
            point_2U.index_select(1, active_A),
            start_U.index_select(0, active_A),
            length_U.index_select(0, active_A),
            center_2L,
            (first, last),
            state_A,
        )
        best_U = best_U.scatter(0, active_A, best_A)
        chosen_U = chosen_U.scatter(0, active_A, chosen_A)
    return chosen_U


def _compare(
    point_2A: Tensor,
    start_A: Tensor,
    length_A: Tensor,
    center_2L: Tensor,
    ranks: tuple[int, int],
    state_A: tuple[Tensor, Tensor],
) -> tuple[Tensor, Tensor]:
    """Least squared distance and its place after the entries of these ranks, one by one."""
    longest = torch.cat([length_A, length_A.new_zeros(1)]).amax(0).clamp(max=ranks[1])

    def step(rank: Tensor, best_A: Tensor, chosen_A: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        place_A = start_A + torch.minimum(rank, length_A - 1)  # the last one again: no change
        distance_A = (point_2A[0] - center_2L[0].index_select(0, place_A)).square()
        distance_A = distance_A + (point_2A[1] - center_2L[1].index_select(0, place_A)).square()
        chosen_A = torch.where(distance_A < best_A, place_A, chosen_A)
        return rank + 1, torch.minimum(distance_A, best_A), chosen_A

    state = (torch.full_like(longest, ranks[0]), *state_A)
    if torch.compiler.is_exporting():
        state = torch.while_loop(lambda rank, *_: rank < longest, step, state)
    else:
        for _ in range(ranks[0], int(longest)):
            state = step(*state)
    return state[1], state[2]
