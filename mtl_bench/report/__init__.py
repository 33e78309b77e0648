"""Tables, plots and the page of a grid, made from its rows and nothing else."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from mtl_bench.report.page import Figure
    from mtl_bench.report.tables import Row, Table

FIGURES = {  # file stem: heading on the page, in its order
    "pq_fps": "Panoptic quality against frames per second",
    "rmse_fps": "Depth error against frames per second",
    "pq_rmse": "Panoptic quality against depth error",
    "samples": "Sample predictions",
    "extremes": "Worst and best frame of each row",
    "classes": "Panoptic quality per class",
    "loss_curves": "Training curves",
    "weight_curves": "Learned weights",
    "diagnostics": "Update norm and gradient cosines",
}


class Grid(Protocol):
    """What a report needs to know of a grid."""

    @property
    def name(self) -> str: ...

    @property
    def question(self) -> str: ...

    @property
    def recipe(self) -> Any: ...

    @property
    def report(self) -> Mapping[str, Any]: ...


def build(
    grid: Grid,
    rows: "Sequence[Row]",
    out_dir: Path,
    runs_root: Path | None = None,
    baseline: "Row | None" = None,
    command: str = "",
) -> Path:
    """Write the page, the tables and the figures; the same rows give the same bytes.

    The tables are `table.{csv,md,tex}` whole and `readme.md` with the main columns.

    Args:
        grid: its name, question, recipe, and under `report` what `layout.Layout` says.
        rows: one per cell in the grid's order, as `row.json` holds them, with a status; a row
            without numbers has at least what names its cell, and its error.
        out_dir: created where absent; what an earlier build left is replaced.
        runs_root: where the runs' curves and samples are; without it those figures are left out.
        baseline: the trivial predictor's metrics, under the same keys as a row's.
        command: what reproduces the report.

    Returns:
        The page's path.

    Raises:
        ValueError: `grid.report` has a key or a value that it cannot have.
    """
    from mtl_bench.report import formats, page
    from mtl_bench.report.layout import Layout
    from mtl_bench.report.tables import tabulate

    layout = Layout.of(grid.report)

    has_section = baseline is None or "metric" in baseline
    metrics = baseline if has_section else {"metric": baseline}
    rows = [*rows, *_skipped(grid)]
    table = tabulate(rows, layout, metrics)
    out_dir.mkdir(parents=True, exist_ok=True)
    for stem in FIGURES:
        for suffix in ("png", "svg"):
            (out_dir / f"{stem}.{suffix}").unlink(missing_ok=True)
    figures = [] if layout.only else _draw(table, out_dir, runs_root)
    files = {
        "table.csv": formats.csv(table),
        "table.md": formats.markdown(table),
        "readme.md": formats.markdown(table, short=True),
        "table.tex": formats.latex(table),
        "index.html": page.render(grid, table, rows, figures, command, out_dir),
    }
    for name, content in files.items():
        (out_dir / name).write_text(content, encoding="utf-8", newline="\n")
    return out_dir / "index.html"


def summary_table(rows: "Sequence[Row]", axis: str = "backbone") -> Any:
    """The main columns as a rich table for a terminal."""
    from mtl_bench.report import formats

    return formats.summary_table(rows, axis)


def _skipped(grid: Grid) -> "list[Row]":
    """The cells that the grid leaves out, as rows that say why."""
    from mtl_bench.core.config import to_dict

    names = getattr(grid, "names", {})
    return [
        {
            **({"name": names[skip.cell.id]} if skip.cell.id in names else {}),
            "slug": skip.cell.slug,
            "seed": skip.cell.seed,
            "cell": to_dict(skip.cell),
            "status": "skipped",
            "error": skip.why,
        }
        for skip in getattr(grid, "skips", ())
    ]


def _draw(table: "Table", out_dir: Path, runs_root: Path | None) -> "list[Figure]":
    from mtl_bench.report import curves, pictures, plots
    from mtl_bench.report.page import Figure

    captions = {
        "pq_fps": plots.against(table, "pq", "fps", out_dir),
        "rmse_fps": plots.against(table, "rmse", "fps", out_dir),
        "pq_rmse": plots.against(table, "pq", "rmse", out_dir),
        "classes": plots.classes(table, out_dir),
    }
    if runs_root is not None:
        runs = _curves(table, runs_root)
        captions["loss_curves"] = curves.terms(table, runs, "loss", out_dir)
        captions["weight_curves"] = curves.terms(table, runs, "weight", out_dir)
        captions["diagnostics"] = curves.diagnostics(table, runs, out_dir)
        captions["samples"] = pictures.draw(table, runs_root, out_dir)
        captions["extremes"] = pictures.extremes(table, runs_root, out_dir)
    drawn = [(stem, heading, captions.get(stem)) for stem, heading in FIGURES.items()]
    return [Figure(stem, heading, caption) for stem, heading, caption in drawn if caption]


def _curves(table: "Table", runs_root: Path) -> dict[str, Any]:
    import pandas as pd

    runs = {}
    for group in table.groups:
        paths = [runs_root / str(row.get("slug", "")) / "curve.csv" for row in group.rows]
        frames = [pd.read_csv(path) for path in paths if path.is_file()]
        if frames:
            runs[group.label] = frames
    return runs
