"""How a report's numbers were made: the settings of its rows, and in which of them rows differ."""

from collections.abc import Mapping, Sequence
from typing import Any

from mtl_bench.report.columns import Row, different, flatten
from mtl_bench.report.statistics import PSEUDO

Protocol = list[tuple[str, list[tuple[str, str, bool]]]]  # title: (name, value, whether it differs)
CELL = {
    "seed": "seed",
    "cell.method": "method",
    "cell.backbone": "backbone",
    "cell.tasks": "tasks",
    "cell.single_task": "one network a task",
    "cell.video": "video stage",
    "cell.granularity": "what is weighed",
    "cell.replay": "replay of its weights",
    "cell.pretrained": "pre-trained weights",
}
SECTIONS = {  # title: dotted prefix of a row
    "Evaluation": "protocol.",
    "Data": "cell.recipe.data.",
    "Network": "cell.recipe.network.",
    "Training": "cell.recipe.optim.",
    "Augmentation": "cell.recipe.augment.",
    "Losses": "cell.recipe.loss.",
    "Pseudo labels": f"cell.{PSEUDO}",
    "Post-processing": "cell.recipe.evaluate.",
    "Environment": "env.",
}
TIMING = (
    *("passes", "warmup", "images", "height", "width"),
    *("device", "precision", "threads", "clock"),
)
FACTS = ("device", "threads", "passes", "warmup", "images", "throughput_batch", "clock")
PEAKS = {"peak_gflops": "GFLOP/s", "peak_gbs": "GB/s"}
SAME = ("argv", "threads", "device", "cpu")  # of a timing's environment: said elsewhere, or no fact


def of_cells(rows: Sequence[Row]) -> Protocol:
    flats = [flatten(row) for row in rows]
    sections = [("Cells", _settings(flats, CELL))]
    for title, prefix in SECTIONS.items():
        # the video stage's settings are in every cell, but say something of its own cells only
        having = [f for f in flats if f.get("cell.video")] if PSEUDO in prefix else flats
        sections.append((title, _settings(having, _below(having, prefix))))
    timing = {f"metric.latency.{name}": name for name in TIMING}
    sections.append(
        ("Latency, batch 1, transfer and post-processing included", _settings(flats, timing))
    )
    return [(title, settings) for title, settings in sections if settings]


def of_timings(rows: Sequence[Row]) -> Protocol:
    """Of rows with numbers; what one of them does not know is not said."""
    known = [{k: v for k, v in flatten(row).items() if v is not None} for row in rows]
    facts = {f"metric.latency.{name}": name for name in FACTS} | {"weights": "weights"}
    facts |= {"trained.slug": "trained by", "timing.recipe": "recipe of the network"}
    costs = {f"metric.roofline.{name}": f"peak, {unit}" for name, unit in PEAKS.items()}
    environment = {k: name for k, name in _below(known, "env.").items() if name not in SAME}
    sections = {"Timing": facts, "Machine's measured peak": costs, "Environment": environment}
    return [(title, found) for title, keys in sections.items() if (found := _settings(known, keys))]


def _below(flats: Sequence[Mapping[str, Any]], prefix: str) -> dict[str, str]:
    keys = dict.fromkeys(key for flat in flats for key in flat if key.startswith(prefix))
    return {key: key.removeprefix(prefix) for key in keys}


def _settings(
    flats: Sequence[Mapping[str, Any]], names: Mapping[str, str]
) -> list[tuple[str, str, bool]]:
    settings = []
    for key, name in names.items():
        values = different(flat[key] for flat in flats if key in flat)
        if values:
            settings.append((name, " | ".join(values), len(values) > 1))
    return settings
