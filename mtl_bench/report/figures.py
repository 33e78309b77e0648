"""Which figures a grid's report has: of each problem, and of the verdicts over all of them."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import pandas as pd

from mtl_bench.bench import tuning
from mtl_bench.bench.tuning import Tried
from mtl_bench.core.style import MANY
from mtl_bench.report import columns as known
from mtl_bench.report import curves, pictures, plots, trials, verdict_plots
from mtl_bench.report.columns import capital, pairs, per_class
from mtl_bench.report.page import Figure, figures_of
from mtl_bench.report.statistics import kept
from mtl_bench.report.verdicts import Verdicts
from mtl_bench.train.curve import read as read_curve

if TYPE_CHECKING:
    from mtl_bench.report.grid import Results

WIDE = ("loss_curves", "weight_curves", "diagnostics", "classes", "samples", "extremes")


def of_verdicts(judged: Verdicts, tried: Sequence[Tried], folder: Path) -> list[Figure]:
    """Those of all problems together, and of trials each problem's trade-off."""
    settings = tuning.ended(tried)
    drawn = {
        "forest": verdict_plots.forest(judged, folder, "forest"),
        "bands": verdict_plots.bands(judged, folder, "bands"),
        "profiles": verdict_plots.profiles(judged, folder, "profiles"),
        "budgets": trials.budgets(judged, settings, folder, "budgets"),
    }
    wide = len(judged.problems) > 1 or len(judged.lines) > MANY
    found = [replace(figure, wide=wide) for figure in figures_of(known.figures(), drawn)]
    for problem in judged.problems:
        stem = f"{problem.replace(', ', '-')}-tradeoff" if len(judged.problems) > 1 else "tradeoff"
        caption = trials.tradeoff(judged, settings, problem, folder, stem)
        if caption is not None:
            heading = ": ".join(filter(None, (problem, known.figures()["tradeoff"].lower())))
            found.append(Figure(stem, capital(heading), caption, wide=True))
    return found


def of_problem(results: "Results", folder: Path, runs_root: Path | None) -> list[Figure]:
    """Those of one problem, under its name where it is one of several."""
    of, headings = results.problem, known.figures()
    where = folder / of
    where.mkdir(exist_ok=True)
    captions = _draw(results, where, runs_root)
    wide = headings if len(results.groups) > MANY else WIDE
    found = [replace(f, wide=f.name in wide) for f in figures_of(headings, captions)]
    if not of:
        return found
    for path in sorted(where.iterdir()):
        path.replace(folder / f"{of}-{path.name}")
    where.rmdir()
    return [replace(f, name=f"{of}-{f.name}", heading=f"{of}: {f.heading}") for f in found]


def _draw(results: "Results", out_dir: Path, runs_root: Path | None) -> dict[str, str | None]:
    """Draw all that can be drawn; what each figure shows, by its stem."""
    captions = {f"{y.name}_{x.name}": plots.against(results, y, x, out_dir) for y, x in pairs()}
    captions |= {
        stem: plots.classes(results, column, out_dir, stem) for stem, column in per_class().items()
    }
    if runs_root is not None:
        runs = {
            group.label: frames
            for group in results.groups
            if (frames := list(kept(group, runs_root, "curve.csv", _curve)))
        }
        captions["loss_curves"] = curves.terms(results, runs, "loss", out_dir)
        captions["weight_curves"] = curves.terms(results, runs, "weight", out_dir)
        captions["diagnostics"] = curves.diagnostics(results, runs, out_dir)
        captions["samples"] = pictures.draw(results, runs_root, out_dir)
        captions["extremes"] = pictures.extremes(results, runs_root, out_dir)
    return captions


def _curve(path: Path) -> pd.DataFrame:
    found: pd.DataFrame = pd.DataFrame(read_curve(path)).apply(pd.to_numeric)
    return found
