"""``ctid schema``."""

from __future__ import annotations

import typer

from ctid_cli.cli._common import guarded


@guarded
def schema() -> None:
    """Print the JSON Schema of experiment files."""
    import json

    from ctid_cli.specification.load import json_schema

    typer.echo(json.dumps(json_schema(), indent=2))
