"""Grid files of both kinds: finding them, reading them, their axes."""

from pathlib import Path
from typing import Any

from mtl_bench.core import plugins, toml_file
from mtl_bench.core.plain import did_you_mean
from mtl_bench.core.toml_file import TomlFile

GRIDS = Path(__file__).parent / "grids"
TRAINING, LATENCY = "training", "latency"  # a file's `kind`; the first where it says none
SHARED: dict[str, type] = {"kind": str, "question": str, "axes": dict, "skip": list, "report": dict}
KEYS: dict[str, dict[str, type]] = {
    TRAINING: SHARED | {"recipe": str, "smoke_recipe": str, "row": list, "baseline": dict},
    LATENCY: SHARED | {"smoke": dict, "weights": dict, "quality": dict},
}
FORMS: dict[type, str] = {
    str: '{} = "text"',
    dict: "[{}], a section",
    list: "[[{}]], two brackets on each side",
}


def grid_names() -> list[str]:
    return sorted(path.stem for path in GRIDS.glob("*.toml"))


def kind_of(file: TomlFile) -> str:
    """What a grid is about: training | latency."""
    return str(file.values.get("kind", TRAINING))


def question_of(name: str) -> str:
    """What a grid asks, without expanding it."""
    return str(read(name).values.get("question", ""))


def read(name: str) -> TomlFile:
    """Find and read a grid file; its keys are known ones and of the right form.

    Raises:
        ValueError: no such grid, or a key that its kind of file cannot have, with its line.
    """
    path = Path(name) if name.endswith(".toml") else GRIDS / f"{name}.toml"
    if not path.is_file():
        hint = "" if name.endswith(".toml") else did_you_mean(name, grid_names())
        raise ValueError(f"no grid called '{name}'{hint}; a file of your own: --grid PATH.toml")
    file = toml_file.read(path)
    kind = kind_of(file)
    if kind not in KEYS:
        raise file.error(f"no kind of grid '{kind}'{did_you_mean(kind, KEYS)}", "kind", ("", 0))
    keys = KEYS[kind]
    for key, value in file.values.items():
        wrong = f"unknown key '{key}'{did_you_mean(key, keys)}" if key not in keys else ""
        if not wrong and not isinstance(value, keys[key]):
            wrong = f"write it as {FORMS[keys[key]].format(key)}"
        if wrong:
            raise file.error(wrong, key, ("", 0), (key, 0))
    file.refuse_sections_in("axes", "row", "skip", "baseline", "smoke", "weights")
    return file


def axes(file: TomlFile) -> dict[str, tuple[Any, ...]]:
    """Each axis and its values; "all" is every plug-in of the axis's kind.

    Raises:
        ValueError: an axis without a list of values, with its line.
    """
    found: dict[str, tuple[Any, ...]] = {}
    for axis, values in file.values.get("axes", {}).items():
        if values == "all" and f"{axis}s" in plugins.KINDS:
            values = list(plugins.files(f"{axis}s"))
        if not isinstance(values, list) or not values:
            message = f"axis '{axis}' is a list of values, not {values!r}"
            raise file.error(message, axis, ("axes", 0))
        found[axis] = tuple(values)
    return found
