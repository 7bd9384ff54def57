"""The ``ctid`` command: registers one function per command and nothing else."""

import gc
import os
from typing import Annotated

import typer

import ctid_cli
from ctid_cli.cli._common import Command
from ctid_cli.cli._progress import Watch
from ctid_cli.cli.experiment_commands import accuracy, init, run, schema, validate
from ctid_cli.cli.fit_command import fit
from ctid_cli.cli.order_command import order
from ctid_cli.cli.page_commands import figure, report
from ctid_cli.cli.record_commands import check, compare, frf
from ctid_cli.cli.reproduce_command import reproduce
from ctid_cli.cli.result_commands import export, merge, status, table, verify
from ctid_cli.cli.track_command import track

# Plain help and error texts are readable in log files, and avoid importing rich.
app = typer.Typer(
    name="ctid",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    add_completion=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"ctid {ctid_cli.__version__}")
        raise typer.Exit()


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Identify continuous-time models with a time delay, and tabulate how often it succeeds.

    `ctid check` and `ctid fit` take a measured record. A YAML file describes one experiment: `ctid init` writes
    examples, `ctid validate` checks it, `ctid run` computes it (the same command again resumes), `ctid table` prints
    the percentages. Exit codes: 0 done, 1 internal error, 2 bad input, 3 refused, 4 every estimate failed, 5 stopped
    early, 6 storage error, 7 difference found, 8 machine out of resources, 130 Ctrl-C, 143 terminated.
    """


_RESULTS = (status, table, figure, report, export, verify)
_RECORDS = (check, fit, compare, order, frf, track)
for _command in (*_RECORDS, init, run, reproduce, merge, *_RESULTS, validate, accuracy, schema):
    app.command(cls=Command)(_command)


def main() -> None:
    """Run the ``ctid`` command."""
    # The matrices are small, so more threads for a product only slow it down. NumPy is not loaded yet.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    Watch.owns_process = True
    # Imports allocate hundreds of thousands of objects and free none: searches for cycles are a tenth of `ctid fit`.
    gc.set_threshold(20_000, 10, 10)
    try:
        app(prog_name="ctid")
    finally:
        # The searches at the end of the process would take a sixth of `ctid fit`, and free nothing that matters.
        gc.freeze()


if __name__ == "__main__":
    main()
