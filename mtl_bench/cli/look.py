"""`list`, `new`, `check` and `env`: what there is, adding to it, and where it runs."""

import textwrap
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from mtl_bench.cli import options as o
from mtl_bench.core.plugins import Description


class What(StrEnum):
    all = "all"
    methods = "methods"
    backbones = "backbones"
    tasks = "tasks"
    datasets = "datasets"
    engines = "engines"
    recipes = "recipes"
    grids = "grids"


class Kind(StrEnum):
    method = "method"
    backbone = "backbone"
    engine = "engine"


def register(app: typer.Typer) -> None:
    panel = "Around"
    app.command("list", rich_help_panel=panel, epilog="Example: mtl-bench list methods -v")(show)
    app.command(rich_help_panel=panel, epilog="Example: mtl-bench new method mine")(new)
    app.command(rich_help_panel=panel, epilog="Example: mtl-bench check mine")(check)
    app.command(rich_help_panel=panel, epilog="Example: mtl-bench env")(env)


def show(
    what: Annotated[What, typer.Argument(help="What to list.")] = What.all,
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="With files and whole descriptions.")
    ] = False,
    markdown: Annotated[
        bool, typer.Option("--markdown", help="Methods as the page methods/README.md.")
    ] = False,
    plugins: o.PluginsOption = None,
) -> None:
    """List methods, backbones, tasks, data sets, engines, recipes and grids; imports none."""
    if markdown:
        typer.echo(_page(what), nl=False)
        return
    for kind in What if what is What.all else [what]:
        if kind is What.all:
            continue
        if what is What.all:
            typer.echo(f"{kind.value}")
        for line in _lines(kind.value, verbose):
            typer.echo(line)


def _lines(kind: str, verbose: bool) -> list[str]:
    from mtl_bench.bench import grid as grids
    from mtl_bench.core import cards, config
    from mtl_bench.core.plugins import describe

    if kind == "recipes":
        return o.columns([[name, config.load_recipe(name).about] for name in config.recipe_names()])
    if kind == "grids":
        return o.columns([[name, grids.question_of(name)] for name in grids.grid_names()])
    if kind == "methods":
        found = cards.cards()
        if verbose:
            return [line for card in found for line in _whole(card.about, cards.details(card))]
        return [*o.columns(cards.rows(found)), f"  {cards.LEGEND}"]
    described = describe(kind)
    if verbose:
        return [line for about in described for line in _whole(about)]
    broken = {about.name: f"BROKEN: {about.error}" for about in described if about.error}
    if kind == "engines":
        return o.columns([_engine(about) for about in described if not about.error]) + o.columns(
            [[name, error] for name, error in broken.items()]
        )
    return o.columns([[about.name, broken.get(about.name, about.summary)] for about in described])


def _engine(about: Description) -> list[str]:
    """Name, precisions, what it is, and what is not installed."""
    from mtl_bench.core.plugins import lack
    from mtl_bench.deploy import engines

    facts = engines.facts(about.name)
    lacking = lack(facts.packages, facts.extra)
    return [about.name, facts.text, about.summary + (f" ({lacking})" if lacking else "")]


def _whole(about: Description, details: Sequence[str] = ()) -> list[str]:
    lines = [f"  {about.name}  ({about.path})"]
    lines += [f"    BROKEN: {about.error}"] if about.error else []
    lines += [f"    {line}" for line in details]
    return [*lines, textwrap.indent(about.doc.rstrip(), "    "), ""]


def _page(what: What) -> str:
    from mtl_bench.core import cards, plugins

    if what is not What.methods:
        raise ValueError("only methods have a page: mtl-bench list methods --markdown")
    return cards.page(cards.cards(), plugins.folders("methods")[0])


def new(
    kind: Annotated[Kind, typer.Argument(help="What to write.")],
    name: Annotated[str, typer.Argument(metavar="NAME", help="Lower-case letters, digits and _.")],
    folder: Annotated[
        Path | None,
        typer.Option("--dir", metavar="DIR", help="Where. [default: ./methods, or as the kind]"),
    ] = None,
) -> None:
    """Write a commented file to start a method, backbone or engine from; it passes `check`."""
    from mtl_bench.bench.scaffold import write

    path = write(f"{kind.value}s", name, folder)
    where = "" if folder is None else f" --plugins {folder}"
    typer.echo(f"{path}\nnext: edit it, then: mtl-bench check {path if folder else name}")
    typer.echo(f"it is found as: mtl-bench list {kind.value}s{where}")


def check(
    names: Annotated[
        list[str],
        typer.Argument(metavar="NAME|FILE...", help="Plug-ins of any kind, by name or by file."),
    ],
    plugins: o.PluginsOption = None,
) -> None:
    """Run the tests that every plug-in has to pass; exit code 1 if one fails."""
    from mtl_bench.core.plain import did_you_mean
    from mtl_bench.core.plugins import KINDS, add_folder, files, kinds_of

    chosen = []
    for word in names:
        name = word
        if word.endswith(".py"):
            add_folder(word)
            name = Path(word).stem
        kinds = kinds_of(name)
        if not kinds and word.endswith(".py"):
            raise ValueError(
                f"{word} is none: a plug-in imports mtl_bench.core.method, backbone, task, dataset "
                "or engine"
            )
        if not kinds:
            known = [known for kind in KINDS for known in files(kind)]
            hint = did_you_mean(name, known)
            raise ValueError(f"no method, backbone or engine called '{name}'{hint}")
        chosen += [(kind, name) for kind in kinds]
    from mtl_bench.bench.check import check as check_plugin

    failed = 0
    for kind, name in chosen:
        typer.echo(f"{kind[:-1]} {name}")
        results = check_plugin(kind, name)
        failed += sum(not result.ok for result in results)
        for line in o.columns([["ok" if r.ok else "FAILED", r.name, r.detail] for r in results]):
            typer.echo(line)
    if failed:
        typer.echo(f"{failed} checks failed", err=True)
        raise typer.Exit(1)


def env(device: o.DeviceOption = o.Device.auto) -> None:
    """Print versions, hardware and code as they would stand in a row."""
    from mtl_bench.core.device import choose_device
    from mtl_bench.core.fingerprint import fingerprints
    from mtl_bench.core.provenance import HARNESS_ROOTS, environment

    prints = {s: fingerprints(s, roots)["harness"] for s, roots in HARNESS_ROOTS.items()}
    harness = "  ".join(f"{stage} {print_}" for stage, print_ in prints.items())
    values = {**environment(choose_device(device.value)), "harness": harness}
    for line in o.columns([[key, str(value)] for key, value in values.items()], indent=""):
        typer.echo(line)
