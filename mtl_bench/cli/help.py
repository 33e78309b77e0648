"""Help as plain text, in the panels that commands and options name.

typer's own takes rich for it, whose import is as long as all the rest of `mtl-bench --help`.
"""

from collections.abc import Iterable
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

WIDTH = 100  # columns, where the terminal has as many


class Command(TyperCommand):
    def format_options(self, ctx: Any, formatter: Any) -> None:
        write_panels(formatter, _parameters(self, ctx))


class Group(TyperGroup):
    def format_options(self, ctx: Any, formatter: Any) -> None:
        commands: dict[str, Any] = {
            name: self.get_command(ctx, name) for name in self.list_commands(ctx)
        }
        first = [
            (command.rich_help_panel or "Commands", (name, _first_paragraph(command)))
            for name, command in commands.items()
        ]
        write_panels(formatter, [*first, *_parameters(self, ctx)])


class App(typer.Typer):
    """Commands, or a group of them."""

    def __init__(self, cls: type[Group] = Group, **settings: Any) -> None:
        context = {"help_option_names": ["-h", "--help"], "max_content_width": WIDTH}
        super().__init__(
            cls=cls,
            no_args_is_help=True,
            add_completion=False,
            pretty_exceptions_enable=False,
            rich_markup_mode=None,
            context_settings=context,
            **settings,
        )

    def command(self, name: str | None = None, **settings: Any) -> Any:
        return super().command(name, cls=Command, **settings)


def write_panels(formatter: Any, records: Iterable[tuple[str, tuple[str, str]]]) -> None:
    """Two columns below each panel's title; panels and lines in the order in which they come."""
    panels: dict[str, list[tuple[str, str]]] = {}
    for panel, record in records:
        panels.setdefault(panel, []).append(record)
    for panel, lines in panels.items():
        with formatter.section(panel):
            formatter.write_dl(lines)


def _parameters(command: Any, ctx: Any) -> list[tuple[str, tuple[str, str]]]:
    """Panels and help of arguments, then of options."""
    found = []
    for parameter in command.get_params(ctx):
        record = parameter.get_help_record(ctx)
        if record is not None:
            usual = "Arguments" if parameter.param_type_name == "argument" else "Options"
            found.append((getattr(parameter, "rich_help_panel", None) or usual, record))
    return found


def _first_paragraph(command: Any) -> str:
    return " ".join((command.help or "").partition("\n\n")[0].split())
