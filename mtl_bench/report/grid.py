"""A grid's report: a line for all cells that differ only in their seed, figures and a page.

Cells of different status never share a line, and neither do measured, trivial and published values.
"""

import itertools
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from markupsafe import Markup

from mtl_bench.bench import tuning
from mtl_bench.bench.tuning import Tried
from mtl_bench.core import quality
from mtl_bench.core.columns import FPS, Column
from mtl_bench.core.config import to_dict
from mtl_bench.core.plain import did_you_mean, from_dict
from mtl_bench.report import columns as known
from mtl_bench.report import figures, protocol, trials, tuned
from mtl_bench.report.columns import (
    ONLY,
    RELATIVE,
    Row,
    capital,
    headlines,
    text,
)
from mtl_bench.report.footnotes import footnotes
from mtl_bench.report.page import PAGE, Figure, Page, beside, render
from mtl_bench.report.statistics import (
    SHOWN,
    SMOKE,
    Group,
    axes_of,
    by_recipe,
    cell_of,
    grouped,
    tested,
    trivial_group,
)
from mtl_bench.report.table import (
    ARROWS,
    FEWER,
    NOTHING,
    WRAP,
    Cell,
    Head,
    Section,
    Table,
    TableRow,
    markdown,
    numbers,
    single,
    write,
)
from mtl_bench.report.verdicts import Verdicts, judge, notes, records, sections, untested

PUBLISHED = Path(__file__).parent / "literature.toml"
AXES = {"recipe.name": "recipe", "name": "configuration", "single_task": "single-task"}
VERDICTS, TRIALS = "verdicts", "trials"  # stems of their files
ALIKE = 5  # cells that lack numbers for one reason and still have a line each
TRAINED_BRIEFLY = "Cells marked smoke were trained for a few steps to show that the pipeline works."


@dataclass(frozen=True)
class Layout:
    """What a grid file's section [report] may say.

    Raises:
        ValueError: a column, figure or part that does not exist.
    """

    rows: str = "backbone"  # the field of a cell that names a line, or "name": the file's [[row]]s
    first: tuple[str, ...] = ()  # columns that stand before the others
    only: str | None = None  # "cost": step time and memory alone, without figures
    reference: str | None = None  # the line (value of `rows`) that these two are relative to, too
    control: str | None = None  # the line that every other is tested against
    readme: tuple[str, ...] | None = None  # figures beside the table in a README; None: over speed

    def __post_init__(self) -> None:
        _check("column", self.first, [column.name for column in known.columns()])
        _check("figure", self.readme or (), known.figures())
        _check("part", () if self.only is None else (self.only,), ONLY)

    @staticmethod
    def of(values: Mapping[str, Any]) -> "Layout":
        """From a grid file's section.

        Raises:
            ValueError: an unknown key, a value of another type, or what `Layout` raises.
        """
        return from_dict(Layout, values, "report.")

    @property
    def pictures(self) -> tuple[str, ...]:
        """Stems of the figures that a README shows."""
        over_speed = (f"{column.name}_{FPS.name}" for column in headlines())
        return tuple(over_speed) if self.readme is None else self.readme


def check(grid: Any) -> None:
    """What `build` would find wrong with a grid's section [report], before there is a row.

    Raises:
        ValueError: a key or a value that it cannot have, or lines by what no cell has.
    """
    layout = Layout.of(grid.report)
    fields = {key for job in grid.jobs for key in cell_of(grid.kind.identity(job))}
    fields |= {"name"} if grid.names else set()
    if fields and layout.rows not in fields:
        raise ValueError(f"[report] rows: no '{layout.rows}'{did_you_mean(layout.rows, fields)}")


def _check(kind: str, names: Iterable[str], possible: Iterable[str]) -> None:
    possible = tuple(possible)
    for name in names:
        if name not in possible:
            raise ValueError(f"[report] names no {kind} '{name}'{did_you_mean(name, possible)}")


# --- what was measured ----------------------------------------------------------------------------


@dataclass(frozen=True)
class Unfinished:
    """A cell without numbers and why."""

    label: str
    slug: str
    status: str  # failed | interrupted | running | missing | skipped
    reason: str


@dataclass(frozen=True)
class Results:
    """A grid's rows in groups; nothing is drawn or written yet."""

    axes: tuple[str, ...]
    groups: tuple[Group, ...]
    baseline: Group | None
    unfinished: tuple[Unfinished, ...]
    published: tuple[Mapping[str, Any], ...]
    all_columns: tuple[Column, ...]
    reference: str | None = None  # the line that some columns are relative to
    control: str | None = None  # the line that those in bold lead by a test
    problem: str = ""  # the recipe, of a grid with several

    @property
    def lines(self) -> tuple[Group, ...]:
        return self.groups + ((self.baseline,) if self.baseline else ())

    @property
    def smoke(self) -> bool:
        return any(group.smoke for group in self.groups)

    @property
    def seeds(self) -> int:
        """The most that a line has."""
        return max((len(group.rows) for group in self.groups), default=0)

    def columns(self, part: str | None = None) -> list[Column]:
        """Those that some group has; of one part, where one is named."""
        return [
            column
            for column in self.all_columns
            if part in (None, column.part)
            and any(g.entries[column.name].count for g in self.groups)
        ]

    def tasks(self) -> set[str]:
        """Those that some group has a metric of."""
        return {column.task for column in self.columns("quality")}


def tabulate(
    rows: Sequence[Row],
    layout: Layout | None = None,
    baseline: Row | None = None,
    problem: str = "",
) -> Results:
    """Group rows by everything but the seed, and say which group leads each column.

    Args:
        rows: as `row.json` holds them, with a status; rows without numbers have an error at most.
        layout: which field of a cell names a line (others join it where they differ), which
            columns there are and how they are ordered.
        baseline: metrics of the trivial predictor.
        problem: the recipe's name where the grid has several, and these are the rows of one.
    """
    layout = layout or Layout()
    axes = axes_of([row for row in rows if row.get("status", "done") in SHOWN], layout.rows)
    trivial = None if baseline is None or layout.only else trivial_group(baseline, axes)
    groups = grouped(rows, axes, trivial, layout.reference, layout.control)
    return Results(
        axes=axes,
        groups=tuple(groups),
        baseline=trivial,
        unfinished=tuple(
            _unfinished(r, axes) for r in rows if r.get("status", "done") not in SHOWN
        ),
        published=published(layout.rows, {text(cell_of(row).get(layout.rows)) for row in rows}),
        all_columns=_columns(layout),
        reference=layout.reference,
        control=layout.control if tested(groups, axes, layout.control) else None,
        problem=problem,
    )


def by_problem(rows: Sequence[Row], layout: Layout) -> dict[str, list[Row]]:
    """The rows of each recipe of a suite, in which lines recur; those of another grid under ""."""
    recipes = by_recipe(rows)
    lines = [{text(cell_of(row).get(layout.rows)) for row in own} for own in recipes.values()]
    recur = any(a & b for a, b in itertools.combinations(lines, 2))
    return recipes if recur and layout.rows != "recipe.name" else {"": list(rows)}


def published(axis: str, names: Iterable[str]) -> tuple[Mapping[str, Any], ...]:
    """The lists of published rows that belong to this row axis.

    A list of named rows belongs to the grid that has at least two of its names.
    """
    lists = tomllib.loads(PUBLISHED.read_text(encoding="utf-8"))["published"]
    return tuple(
        entry
        for entry in lists
        if entry["axis"] == axis
        and (axis != "name" or len({row["name"] for row in entry["rows"]} & set(names)) > 1)
    )


def _columns(layout: Layout) -> tuple[Column, ...]:
    """All that a table of this layout may show, in its order."""
    columns = list(known.columns())
    if layout.reference is not None:
        for column in RELATIVE:  # each behind the one that it is made of
            at = next(i for i, other in enumerate(columns) if other.name == column.key)
            columns.insert(at + 1, replace(column, unit=f"x of {layout.reference}"))
    if layout.only is not None:
        columns = [column for column in columns if column.name in ONLY[layout.only]]
    first = {name: i for i, name in enumerate(layout.first)}
    return tuple(sorted(columns, key=lambda column: first.get(column.name, len(first))))


def _unfinished(row: Row, axes: tuple[str, ...]) -> Unfinished:
    cell = cell_of(row)
    label = ", ".join(text(cell[axis]) for axis in axes if axis in cell)
    lines = [line.strip() for line in str(row.get("error") or "").splitlines() if line.strip()]
    seed = f", seed {row['seed']}" if "seed" in row else ""
    return Unfinished(
        label=(label or str(row.get("slug", ""))) + seed,
        slug=str(row.get("slug", "")),
        status=str(row["status"]),
        reason=lines[-1] if lines else "no numbers yet",
    )


# --- the table ------------------------------------------------------------------------------------


def fill(results: Results, short: bool = False) -> Table:
    """Quality and cost, then what has no numbers, what others published, and the notes.

    Args:
        short: one table of the main columns in place of quality and cost, as for a README.
    """
    notes = tuple(footnotes(results))
    main = [c for c in results.columns() if c.short or c.headline]
    banner = f"{SMOKE.capitalize()}." if results.smoke else ""
    said = {"Quality": f" {' '.join(notes)}"}
    of = f"{results.problem}: " * bool(results.problem)
    alike: dict[tuple[str, str], list[Unfinished]] = {}
    for cell in results.unfinished:
        alike.setdefault((cell.status, cell.reason), []).append(cell)
    lacking = [line for cells in alike.values() for line in _without_numbers(of, cells)]
    why = Head("why", left=True, css=WRAP), Head("folder", left=True, page_only=True)
    heads = (*Head.words("cell", "status"), *why)
    return Table(
        sections=tuple(
            _section(
                results,
                capital(of + heading.lower()) if of else heading,
                columns,
                f"{banner} {of}{heading}.{said.get(heading, '')}",
            )
            for heading, columns in ([("", main)] if short and main else parts_of(results))
        ),
        notes=notes,
        records=tuple(_records(results)),
        lacking=Section.lacking("Cells", heads, lacking),
        published=tuple(_published(source, results.axes[0]) for source in results.published),
        banner=banner,
    )


def _without_numbers(of: str, alike: Sequence[Unfinished]) -> list[TableRow]:
    """A line each of cells with the same status and reason, one line of very many."""
    first, last = alike[0], alike[-1]
    if len(alike) <= ALIKE:
        return [TableRow.of(of + c.label, c.status, c.reason, c.slug) for c in alike]
    named = f"{of}{len(alike)} cells, {first.label} to {last.label}"
    return [TableRow.of(named, first.status, first.reason, "")]


def together(tables: Sequence[Table]) -> Table:
    """Those of a suite's problems as one."""
    lacking = [section for table in tables for section in table.lacking]
    lines = tuple(line for section in lacking for line in section.lines)
    return Table(
        sections=tuple(section for table in tables for section in table.sections),
        notes=tuple(dict.fromkeys(note for table in tables for note in table.notes)),
        records=tuple(record for table in tables for record in table.records),
        lacking=(replace(lacking[0], lines=lines),) if lacking else (),
        published=tuple(section for table in tables for section in table.published),
        banner=next((table.banner for table in tables if table.banner), ""),
    )


def parts_of(results: Results) -> list[tuple[str, list[Column]]]:
    """Quality with the speed that pays for it, and the cost."""
    speed = [column for column in results.columns() if column == FPS]
    main = results.columns("quality")
    parts = [("Quality", main and main + speed), ("Cost", results.columns("cost"))]
    return [(heading, columns) for heading, columns in parts if columns]


def axis_title(axis: str) -> str:
    return AXES.get(axis, axis.removeprefix("recipe."))


def _section(results: Results, heading: str, columns: Sequence[Column], caption: str) -> Section:
    """The lines that have a value in one of these columns."""
    shown = [g for g in results.lines if any(g.entries[c.name].count for c in columns)]
    return Section(
        heading=heading,
        heads=(*Head.words(*map(axis_title, results.axes)), Head("n"), *map(Head.of, columns)),
        lines=tuple(_line(group, columns, results.seeds) for group in shown),
        caption=caption.strip(),
    )


def _line(group: Group, columns: Iterable[Column], most: int) -> TableRow:
    count = len(group.rows)
    fewer = FEWER * (count < most)
    seeds = NOTHING if group.status == "trivial" else f"{count}{fewer}"
    name = Cell.marked(group.identity[0], group.mark)
    values = [Cell.of(group.entries[c.name], c, count) for c in columns]
    css = group.status + " smoke" * group.smoke
    return TableRow.of(name, *group.identity[1:], seeds, *values, css=css)


def _published(source: Mapping[str, Any], axis: str) -> Section:
    shown = [c for c in (*headlines(), FPS) if any(c.name in row for row in source["rows"])]
    units = [f" ({c.unit})" if c.unit.isalpha() else "" for c in shown]
    heads = [Head(f"{c.title}{u} {ARROWS[c.better]}") for c, u in zip(shown, units, strict=True)]
    rows = [
        [row["name"], *(f"{row[c.name]:.1f}" if c.name in row else NOTHING for c in shown)]
        for row in source["rows"]
    ]
    why = "other images, another machine"
    heads = [*Head.words(axis_title(axis)), *heads]
    return Section.published(source, tuple(heads), rows, "rows", why, fit=False)


def _records(results: Results) -> Iterator[dict[str, Any]]:
    """A line per group: identity, kind, n, then mean and deviation of each column that has some."""
    every = [c for c in known.columns() if any(g.entries[c.name].count for g in results.lines)]
    of = {"recipe.name": results.problem} if results.problem else {}
    for group in results.lines:
        named = dict(zip(results.axes, group.identity, strict=True)) | of
        kind = "trivial" if group.status == "trivial" else "measured"
        named |= {"kind": kind, "mark": group.mark, "n": str(len(group.rows))}
        relative = RELATIVE if results.reference is not None else ()
        yield (
            named | numbers(group.entries, every) | numbers(group.entries, relative, spread=False)
        )
    for source in results.published:
        for row in source["rows"]:
            named = {results.axes[0]: row["name"], "kind": "published", "mark": source["mark"]}
            found = [c for c in (*headlines(), FPS) if c.name in row]
            found.sort(key=lambda c: bool(c.note))  # papers do not say what a note says of ours
            yield named | {c.name + "_published" * bool(c.note): row[c.name] for c in found}
    for cell in results.unfinished:
        named = {results.axes[0]: cell.label, **of, "kind": cell.status, "mark": cell.reason}
        yield named | {"n": "0"}


# --- the report -----------------------------------------------------------------------------------


def build(
    grid: Any,
    rows: Sequence[Row],
    out_dir: Path,
    runs_root: Path | None = None,
    baseline: Row | None = None,
    command: str = "",
    tried: Sequence[Tried] = (),
) -> Path:
    """Write the page, the tables and the figures; the same rows give the same bytes.

    The tables are `table.{csv,md,tex}` whole, `readme.md` with the main columns, with a control
    `verdicts.csv`, and of a grid that is tuned `trials.csv`. A suite has quality and cost of each
    problem, and figures under its name.

    Args:
        grid: its name, question, recipe, and under `report` what `Layout` says.
        rows: one per cell in the grid's order, as `row.json` holds them, with a status; a row
            without numbers has at least what names its cell, and its error.
        out_dir: created where absent; what an earlier build left is replaced.
        runs_root: where the runs' curves and samples are; without it those figures are left out.
        baseline: the trivial predictor's metrics, under the same keys as a row's.
        command: what reproduces the report.
        tried: the trials of a grid that is tuned.

    Returns:
        The page's path.

    Raises:
        ValueError: `grid.report` has a key or a value that it cannot have.
    """
    layout = Layout.of(grid.report)
    has_section = baseline is None or "metric" in baseline
    baseline = baseline if has_section else {"metric": baseline}
    rows = [*rows, *_skipped(grid)]
    problems = [
        tabulate(own, layout, baseline, name) for name, own in by_problem(rows, layout).items()
    ]
    judged = judge(rows, layout.rows, layout.control) if layout.control is not None else None
    with beside(out_dir, (*known.figures(), VERDICTS, TRIALS)) as folder:
        drawn = [] if judged is None else figures.of_verdicts(judged, tried, folder)
        for results in () if layout.only else problems:
            drawn += figures.of_problem(results, folder, runs_root)
        _write(grid, rows, problems, judged, tried, drawn, folder, command)
    return out_dir / PAGE


def _write(
    grid: Any,
    rows: Sequence[Row],
    problems: Sequence[Results],
    judged: Verdicts | None,
    tried: Sequence[Tried],
    drawn: Sequence[Figure],
    folder: Path,
    command: str,
) -> None:
    table = together([fill(results) for results in problems])
    brief = together([fill(results, short=True) for results in problems])
    groups = [group for results in problems for group in results.groups]
    control, tune = Layout.of(grid.report).control, getattr(grid, "tune", None)
    more = {f"{TRIALS}.csv": trials.records(tried)} if tried else {}
    if judged is not None:
        first, said = sections(judged, tune), tuple(notes(judged))
        behind = trials.distances(judged, tuning.ended(tried))
        first += [] if behind is None else [behind]
        table = replace(table, sections=(*first, *table.sections), notes=(*said, *table.notes))
        if len(problems) == 1:
            brief = replace(brief, sections=(*first, *brief.sections), notes=(*said, *brief.notes))
        else:  # the verdicts; each problem's numbers are on the page
            brief = replace(brief, sections=tuple(first[:1]), notes=said)
        more[f"{VERDICTS}.csv"] = records(judged)
    elif control is not None:
        lines = [", ".join(group.identity) for group in groups]
        table = replace(table, notes=(*table.notes, untested(control, lines)))
    if tune is not None:
        table = replace(table, sections=(*table.sections, tuned.section(rows, tune)))
    counts = [counted_images(results) for results in problems]
    page = Page(
        kind="grid",
        title=f"{grid.name}: mtl-bench report",
        heading=grid.question or grid.name,
        about=Markup("Grid <b>{}</b>, recipe <b>{}</b>. Cells: {}.").format(
            grid.name, getattr(grid.recipe, "name", grid.recipe), _states(rows) or "none"
        ),
        command=command,
        banner=f"{table.banner} {TRAINED_BRIEFLY}" if table.banner else "",
        lacking="Cells without numbers",
        nothing="No cell of this grid has numbers yet.",
        figures=drawn,
        protocol=protocol.of_cells([row for group in groups for row in group.rows]),
        of="cells",
        files=tuple(more),
        counted=[section for section in counts if section is not None],
        folded=_every_cell(rows),
    )
    more |= {"readme.md": markdown(brief), PAGE: render(page, table, folder)}
    write(table, folder, more)


def _skipped(grid: Any) -> list[Row]:
    """The cells that the grid leaves out, as rows that say why."""
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


def counted_images(results: Results) -> Section | None:
    """What the evaluation counted, summed over a group's seeds."""
    counts = {k: v for said in quality.declared("counts").values() for k, v in said.items()}
    lines = []
    for group in results.groups:
        values = [[row.get("metric", {}).get(key) for row in group.rows] for key in counts]
        found = [[value for value in several if value is not None] for several in values]
        if any(found):
            sums = [Cell(f"{sum(several):g}" if several else NOTHING) for several in found]
            lines.append(TableRow.of(group.label, *sums))
    heads = (*Head.words(axis_title(results.axes[0])), *map(Head, counts.values()))
    title = f"{'; '.join(quality.words('counted', results.tasks()))} (all seeds together)"
    return Section(title, heads, tuple(lines)) if lines else None


def _states(rows: Iterable[Row]) -> str:
    """`11 done, 1 failed`."""
    states = [str(row.get("status", "done")) for row in rows]
    order = dict.fromkeys((*SHOWN, *sorted(states)))
    return ", ".join(f"{states.count(state)} {state}" for state in order if state in states)


def _every_cell(rows: Sequence[Row]) -> Section | None:
    """Every cell on its own: slug, seed, status, and the numbers that carry the table."""
    brief = quality.in_brief()
    brief = [column for column in quality.quality() if column in brief]
    shown = [*(c for c in brief if any(single(row, c) != NOTHING for row in rows)), FPS]
    lines = []
    for row in rows:
        state = str(row.get("status", "done")) + " (smoke)" * bool(row.get("smoke"))
        named = str(row.get("slug", "")), text(row.get("seed", "")), state
        lines.append(TableRow.of(*named, *(single(row, column) for column in shown)))
    heads = [Head("run", left=True), Head("seed"), Head("status", left=True)]
    heads += [Head(column.title) for column in shown]
    about = f"{len(rows)} cells, one line each"
    return Section("Every cell", tuple(heads), tuple(lines), source=about) if rows else None
