"""What a method is, read from its file: source, needs, cost, hyper-parameters; for lists and pages.

Like `plugins.describe`, this reads text and runs nothing: what a base class declares is read from
its file, too, be it `mtl_bench/core/method.py` or a helper beside the method.
"""

import ast
import json
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import quote

from mtl_bench.core import plugins
from mtl_bench.core.declared import arguments_of, declared_in
from mtl_bench.core.fingerprint import forget_edited
from mtl_bench.core.plugins import Description
from mtl_bench.core.text import in_markdown

VENUE = re.compile(r"\b([A-Z][A-Za-z]+) ((?:19|20)\d\d)\b")
PREPRINT = re.compile(r"\barXiv:(\d{4}\.\d{4,5})")
ADDRESS = re.compile(r"\b(?:https?://)?((?:[a-z]+\.)+[a-z]{2,}/[^\s,;)]+)")
HEADING = re.compile(r"^(?:Args|Raises):$", re.MULTILINE)

LEGEND = (
    "Cost of a step: F forward pass, B ordinary backward pass. Of each of K losses, H is the "
    "backward pass through its decoder, T the one through the shared encoder."
)


@dataclass(frozen=True)
class Card:
    about: Description
    formula: str = ""  # the class's docstring, down to its arguments
    venue: str = ""  # of its source; empty where the file names none
    year: str = ""
    url: str = ""
    needs: str = ""  # losses | gramian | representation | jacobian; empty in a broken file
    extras: tuple[str, ...] = ()  # what it asks for beyond that
    cost: str = ""  # of a step, in the letters of LEGEND
    settings: Mapping[str, str] = field(default_factory=dict)  # name -> default, as Python text
    space: Mapping[str, Any] = field(default_factory=dict)  # what trials draw


def cards() -> list[Card]:
    """One for every method that is found, in order of name."""
    forget_edited()
    return [_card(about) for about in plugins.describe("methods")]


def _card(about: Description) -> Card:
    line = [] if about.error else plugins.lineage("methods", about.path)
    if not line:
        return Card(about)
    source = _source(about.doc)
    published, declared = VENUE.search(source), declared_in(line)
    return Card(
        about,
        formula=HEADING.split(ast.get_docstring(line[0]) or "")[0].strip(),
        venue=published[1] if published else "",
        year=published[2] if published else "",
        url=_url(source),
        needs=str(declared.get("needs", "")),
        extras=tuple(_extras(line)),
        cost=_cost(line),
        settings={k: argument.text for k, argument in arguments_of(line).items()},
        space=declared["space"],
    )


def _source(doc: str) -> str:
    """The paragraph that says where a method is from, on one line."""
    paragraphs = (" ".join(text.split()) for text in doc.split("\n\n"))
    return next((text for text in paragraphs if text.startswith("Source:")), "")


def _url(source: str) -> str:
    preprint, address = PREPRINT.search(source), ADDRESS.search(source)
    if preprint:
        return f"https://arxiv.org/abs/{preprint[1]}"
    return f"https://{address[1].rstrip('.')}" if address else ""


# --- what a line of classes declares --------------------------------------------------------------


def _is_a(line: Sequence[ast.ClassDef], base: str) -> bool:
    return base in [node.name for node in line]


def _extras(line: Sequence[ast.ClassDef]) -> Iterator[str]:
    values = declared_in(line)
    if values["reevaluates"]:
        yield "the losses after the step"
    if _is_a(line, "LookAheadMethod"):
        yield "the gradients of a second batch ahead"
    elif values["batches"] != 1:
        yield f"{values['batches']} batches"
    if _is_a(line, "Wrapper"):
        yield "a method behind it that it wraps"
    if values.get("weighted_heads") or _is_a(line, "Composed"):
        yield "weighted decoders"


def _cost(line: Sequence[ast.ClassDef]) -> str:
    """As `backward` spends it; what the method itself computes is not in it."""
    values = declared_in(line)
    if values.get("needs") == "losses":
        return "2F + 1B" if values["reevaluates"] else "1F + 1B"
    if _is_a(line, "PerturbedMethod"):
        return "1F + 1B + K(3F + H + T)"
    if _is_a(line, "CrossMethod"):  # decoders' own parameters only of the third
        return "3F + 2K(H + T) + KH + 1T"
    batches = values["batches"]
    each = "" if batches == 1 else batches
    if values.get("needs") == "representation":
        return f"{batches}F + {each}KH + {batches}T"
    return f"{batches}F + {each}K(H + T)"


# --- text -----------------------------------------------------------------------------------------

HEAD = ["name", "year", "venue", "needs", "cost", ""]


def rows(found: Iterable[Card]) -> list[list[str]]:
    """A head and a row a method, for aligned columns."""
    body = [
        [card.about.name, card.year, card.venue, card.needs, card.cost, _one_line(card)]
        for card in found
    ]
    return [HEAD, *body]


def details(card: Card) -> list[str]:
    """Where it was published, what it needs, its hyper-parameters; a line each."""
    lines = [" ".join(filter(None, (card.venue, card.year, card.url)))]
    if card.needs:
        lines.append(f"needs {', '.join((card.needs, *card.extras))}; cost {card.cost}")
    lines.append(", ".join(f"{key}={default}" for key, default in card.settings.items()))
    return [line for line in lines if line]


PAGE = """# Weighting methods

One method a file: its docstring has the source, what departs from it and where public code differs.
A loss-value method and a gradient method together are a method, too: `--method a+b`; a wrapper goes
before the gradient method. This page is written by `mtl-bench list methods --markdown`.

{table}

{legend}
{toy}
## Formulas and hyper-parameters

L losses, w weights, g gradients, J and G their matrix and Gramian, d the update direction of what
is shared. Hyper-parameters are set with `--set method.NAME=VALUE`.

{sections}"""


TOY = """
## On the field's toy

Two losses of two parameters (`mtl_bench/show/toy.py` has them and their source). The published
learning rate is 0.001; at the larger ones below the plain sum arrives, too.

![Every method's paths from five starts]({paths})

![Steps to the Pareto set by learning rate]({steps})

`mtl-bench figure toy --methods NAME,NAME --out toy.png` draws both.
"""


def page(found: Iterable[Card], folder: Path) -> str:
    """Markdown: a table of methods, then each one's formula and hyper-parameters.

    Args:
        folder: where the page will lie, which links to the files lead from.
    """
    found = list(found)
    head = ["method", "source", "needs", "cost per step", "what it does"]
    lines = [head, ["---"] * len(head), *(_table_row(card, folder) for card in found)]
    return PAGE.format(
        table="\n".join(f"| {' | '.join(line)} |" for line in lines),
        legend=LEGEND,
        toy=_toy(folder),
        sections="\n".join(map(_section, found)),
    )


def _toy(folder: Path) -> str:
    """The two pictures, where they lie beside the package, as they do in a checkout."""
    files = [plugins.PACKAGE.parent / f"reports/figures/toy{more}.png" for more in ("", "-steps")]
    if not all(file.is_file() for file in files):
        return ""
    paths, steps = (Path(os.path.relpath(file, folder)).as_posix() for file in files)
    return TOY.format(paths=paths, steps=steps)


def _table_row(card: Card, folder: Path) -> list[str]:
    target = quote(Path(os.path.relpath(card.about.path, folder)).as_posix())
    source = f"{card.venue} {card.year}".strip()
    cells = [source, card.needs, card.cost, _one_line(card)]
    return [f"[{in_markdown(card.about.name)}]({target})", *map(in_markdown, cells)]


def _section(card: Card) -> str:
    fence = "`" * max(3, _longest_ticks(card.formula) + 1)
    formula = f"{fence}text\n{card.formula}\n{fence}\n" if card.formula else ""
    settings = ", ".join(_code(f"{key}={default}") for key, default in card.settings.items())
    notes = [f"Source: <{card.url}>." if card.url else ""]
    notes += [f"Needs {', '.join((card.needs, *card.extras))}." if card.needs else ""]
    notes += [f"Hyper-parameters: {settings}." if settings else ""]
    drawn = ", ".join(_code(f"{key} = {json.dumps(where)}") for key, where in card.space.items())
    notes += [f"Trials draw {drawn}." if drawn else ""]
    return f"### {in_markdown(card.about.name)}\n\n{formula}\n{' '.join(filter(None, notes))}\n"


def _code(text: str) -> str:
    ticks = "`" * (_longest_ticks(text) + 1)
    return f"{ticks}{text}{ticks}"


def _longest_ticks(text: str) -> int:
    return max(map(len, re.findall("`+", text)), default=0)


def _one_line(card: Card) -> str:
    return f"BROKEN: {card.about.error}" if card.about.error else card.about.summary
