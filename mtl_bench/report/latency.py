"""Tables, plots and the page of a grid of latencies, made from its rows and nothing else."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mtl_bench.report.tables import Row

FIGURES = {  # file stem: heading on the page, in its order
    "pq_fps": "Panoptic quality against frames per second",
    "rmse_fps": "Depth error against frames per second",
    "stages": "Where the time of a frame goes",
    "roofline": "Roofline",
}


def build(
    grid: Any,
    rows: "Sequence[Row]",
    out_dir: Path,
    quality: "Sequence[Row]" = (),
    command: str = "",
) -> Path:
    """Write the page, the tables and the figures; the same rows give the same bytes.

    Args:
        grid: its name, question, recipe and skips.
        rows: one per timing in the grid's order, as `latency_runs.rows` gives them.
        out_dir: created where absent; what an earlier build left is replaced.
        quality: done rows of trained cells of the same backbones.
        command: what reproduces the report.

    Returns:
        The page's path.
    """
    from mtl_bench.report import latency_files, latency_plots
    from mtl_bench.report.latency_table import tabulate
    from mtl_bench.report.page import Figure

    table = tabulate(rows, quality)
    out_dir.mkdir(parents=True, exist_ok=True)
    for stem in FIGURES:
        for suffix in ("png", "svg"):
            (out_dir / f"{stem}.{suffix}").unlink(missing_ok=True)
    captions = {
        "pq_fps": latency_plots.against_quality(table, "pq", out_dir),
        "rmse_fps": latency_plots.against_quality(table, "rmse", out_dir),
        "stages": latency_plots.stages(table, out_dir),
        "roofline": latency_plots.roofline(table, out_dir),
    }
    drawn = [(stem, heading, captions[stem]) for stem, heading in FIGURES.items()]
    figures = [Figure(stem, heading, caption) for stem, heading, caption in drawn if caption]
    return latency_files.write(grid, table, figures, out_dir, command)
