"""The Pareto front: the points that no other point beats in both of two numbers."""

from collections.abc import Sequence

from matplotlib.axes import Axes

from mtl_bench.report.style import GRAY

Point = tuple[float, float]


def front(points: Sequence[Point], better: tuple[int, int] = (+1, +1)) -> list[int]:
    """Indices of the points that are not dominated, by growing first number.

    Args:
        better: of each number, +1: higher, -1: lower.

    A point is dominated by one that is at least as good in both numbers and better in one; equal
    points do not dominate each other. Unlike a convex hull, it has no point of a mixture.
    """
    signed = [(better[0] * x, better[1] * y) for x, y in points]

    def dominated(own: Point) -> bool:
        return any(x >= own[0] and y >= own[1] and (x, y) != own for x, y in signed)

    kept = [index for index, own in enumerate(signed) if not dominated(own)]
    return sorted(kept, key=lambda index: points[index])


def draw(axes: Axes, points: Sequence[Point], better: int) -> None:
    """The front as stairs from edge to edge of axes that show the points already.

    Args:
        better: of the second number, +1: higher, -1: lower; of the first it is higher.

    Their height is the second number that can be had at the first number or more.
    """
    corners = [points[index] for index in front(points, (+1, better))]
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    ends = (left, corners[0][1]), (corners[-1][0], low if better > 0 else high)
    xs, ys = zip(ends[0], *corners, ends[1], strict=True)
    axes.plot(xs, ys, drawstyle="steps-pre", color=GRAY, linewidth=1.2, zorder=1)
    axes.set_xlim(left, right)
    axes.set_ylim(low, high)
