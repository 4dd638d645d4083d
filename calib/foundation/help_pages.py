"""Pages of `-h`: commands and options in groups (`rich_help_panel`), with whole sentences."""

from collections.abc import Iterable
from typing import Any, Final

from typer.core import TyperCommand, TyperGroup

_LONGEST_SENTENCE: Final = 1000  # characters of a command's first sentence


class GroupedCommands(TyperGroup):
    """A program whose help lists its commands in groups, each with its whole first sentence."""

    def format_commands(self, _ctx: Any, formatter: Any) -> None:  # noqa: ANN401 - another class in each typer
        """Write a section for each group."""
        shown = [(name, command) for name, command in self.commands.items() if not command.hidden]
        _write_sections(
            formatter,
            ((_group(each, "Commands"), (name, each.get_short_help_str(_LONGEST_SENTENCE))) for name, each in shown),
        )


class GroupedOptions(TyperCommand):
    """A command whose help lists its options in groups, those without a group first."""

    def format_options(self, ctx: Any, formatter: Any) -> None:  # noqa: ANN401 - another class in each typer
        """Write a section for the arguments and for each group of options."""
        records = [(each, each.get_help_record(ctx)) for each in self.get_params(ctx)]
        shown = [
            ("Arguments" if each.param_type_name == "argument" else _group(each, "Options"), record)
            for each, record in records
            if record is not None
        ]
        order = ("Arguments", "Options")
        _write_sections(formatter, sorted(shown, key=lambda each: (*order, each[0]).index(each[0])))


def _group(of: Any, without: str) -> str:  # noqa: ANN401 - a command or an option
    return getattr(of, "rich_help_panel", None) or without


def _write_sections(formatter: Any, entries: Iterable[tuple[str, tuple[str, str]]]) -> None:  # noqa: ANN401
    """Write entries, each with its section's name, in the order in which the sections come first."""
    sections: dict[str, list[tuple[str, str]]] = {}
    for name, entry in entries:
        sections.setdefault(name, []).append(entry)
    for name, rows in sections.items():
        with formatter.section(name):
            formatter.write_dl(rows)
