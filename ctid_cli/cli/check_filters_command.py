"""``ctid check filters``."""

from __future__ import annotations

from typing import Annotated

import typer

from ctid_cli.cli._common import Json, echo_json, guarded


@guarded
def check_filters(
    bandwidth: Annotated[
        float, typer.Option("--bandwidth", metavar="RAD/S", help="Bandwidth of the system, its last -3 dB crossing.")
    ],
    largest_error: Annotated[
        float, typer.Option("--largest-error", metavar="SECONDS", help="Largest error of an initial delay.")
    ],
    filters: Annotated[int, typer.Option("--filters", metavar="N", help="Number of filters, at least 2.")] = 10,
    beta: Annotated[
        float, typer.Option("--beta", metavar="RATIO", help="Longest over shortest period, 1.717 to 10.")
    ] = 10.0,
    as_json: Json = False,
) -> None:
    """Say whether a set of low-pass filters leads a delay estimate past local minima.

    A search that switches between the filters must find, from every wrong delay, one filter whose cost falls to a
    minimum closer to the true delay. The first line says PASS or NOT PASSED; then come the filters, which of them
    serves which delay error, and how many are sure to suffice. The exit code is 0 either way.
    """
    from ctid_cli.errors import UsageError
    from ctid_cli.filtering.filter_set import FilterSet
    from ctid_cli.filtering.filter_set import check_filters as verify
    from ctid_cli.reporting.filter_report import filter_object, filter_text
    from ctid_cli.signals.checks import require_integer, require_positive

    try:
        require_positive("--bandwidth", bandwidth, "rad/s")
        require_positive("--largest-error", largest_error, "s")
        require_integer("--filters", filters, 2)
        chosen = FilterSet(bandwidth, filters, beta)
        found = verify(chosen.cutoffs, largest_error)
    except ValueError as error:
        raise UsageError(str(error)) from None
    if as_json:
        echo_json(filter_object(chosen, found))
    else:
        typer.echo(filter_text(chosen, found))
