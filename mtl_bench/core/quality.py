"""What the tasks' metrics are: one column each, in the order in which a table has them."""

from mtl_bench.core.columns import Column

QUALITY = (
    Column(
        *("pq", "panoptic.pq", "PQ", +1, 1, "%"),
        task="panoptic",
        in_delta=True,
        headline=True,
        words="panoptic quality",
    ),
    Column("pq_things", "panoptic.pq_things", "PQ things", +1, 1, "%", task="panoptic"),
    Column("pq_stuff", "panoptic.pq_stuff", "PQ stuff", +1, 1, "%", task="panoptic"),
    Column("miou", "semantic.miou", "mIoU", +1, 1, "%", task="panoptic", in_delta=True, short=True),
    Column(
        *("abs_rel", "depth_median.abs_rel", "AbsRel", -1, 3, "", "median-scaled"),
        task="depth",
        in_delta=True,
        short=True,
    ),
    Column(
        *("rmse", "depth_median.rmse", "RMSE", -1, 2, "m", "median-scaled"),
        task="depth",
        in_delta=True,
        headline=True,
        words="depth error",
    ),
    Column(
        *("delta1", "depth_median.delta1", "delta1", +1, 3, "", "median-scaled"),
        task="depth",
        in_delta=True,
        tex=r"$\delta_1$",
    ),
    Column(
        *("rmse_dgc", "depth_dgc.rmse", "RMSE dgc", -1, 2, "m", "dgc-scaled"),
        task="depth",
        short=True,
    ),
)


def in_brief() -> list[Column]:
    """The first numbers that one wants to see: each task's headlines, then its other short ones."""
    tasks = list(dict.fromkeys(column.task for column in QUALITY))
    shown = [c for c in QUALITY if c.headline or (c.short and c.in_delta)]
    return sorted(shown, key=lambda column: (tasks.index(column.task), not column.headline))
