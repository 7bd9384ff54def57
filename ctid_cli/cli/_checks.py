"""``ctid check``: a command of its own for a FILE, and a group of further checks beside it."""

from __future__ import annotations

from typing import Any

import typer

from ctid_cli.cli._common import Command
from ctid_cli.cli.check_accuracy_command import check_accuracy
from ctid_cli.cli.check_filters_command import check_filters

_further = typer.Typer(rich_markup_mode=None, context_settings={"help_option_names": ["-h", "--help"]})
# A further check is registered here, under its name.
_further.command("filters", cls=Command)(check_filters)
_further.command("accuracy", cls=Command)(check_accuracy)


class CheckCommand(Command):
    """``ctid check FILE``, which hands over if the first word names a further check: such a file is ``./filters``."""

    further = typer.main.get_group(_further).commands

    def make_context(self, info_name: str | None, args: list[str], parent: Any = None, **extra: Any) -> Any:
        """Parse the command line."""
        if args and args[0] in self.further:
            return self.further[args[0]].make_context(f"{info_name} {args[0]}", args[1:], parent, **extra)
        return super().make_context(info_name, args, parent, **extra)

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """Write the end of the help: the further checks."""
        with formatter.section("Further checks"):
            formatter.write_dl([(name, command.get_short_help_str(80)) for name, command in self.further.items()])
