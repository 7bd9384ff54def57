"""The tables that are committed beside the program, and what made them."""

import csv
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from ctid_cli.errors import UsageError
from ctid_cli.reporting.percentages import Row
from ctid_cli.reporting.study import DEFAULT_STUDY, data_folder, study_contents
from ctid_cli.running.plan import build_plan, current_version
from ctid_cli.specification.load import load_spec

#: Columns that tables must have to be compared with.
NEEDED = ("table", "experiment", "initial_delay", "method", "n", "converged")


def committed_tables(study: str = DEFAULT_STUDY) -> Path | None:
    """Return the file of a study's committed tables, None if there is none."""
    folder = data_folder("results/published") / study.replace("-", "_")
    return folder / "tables.csv" if (folder / "tables.csv").is_file() else None


def environment_of(published: Path) -> dict[str, Any] | None:
    """The commit and the sessions that made the published results in a folder; None where there are none."""
    try:
        content: dict[str, Any] = json.loads((published / "environment.json").read_text(encoding="utf-8"))
    except OSError:
        return None
    return content


def made_by(published: Path, study: str = DEFAULT_STUDY) -> str:
    """Which code computed the published results in a folder, as a participle clause; empty where it is the present."""
    environment = environment_of(published)
    if environment is None:
        return ""
    if all(_versions(own) <= _present(study, short) for short, own in environment["sessions"].items()):
        return ""
    commit = environment["commit"][:12]
    return f"computed by an earlier version of the code or of its numerical libraries (commit {commit})"


def _present(study: str, short: str) -> set[str]:
    """The code versions that the estimates of an experiment of a study would have now."""
    described = study_contents()[study]["experiments"].get(f"{study}/{short}")
    if described is None:
        return set()
    return {current_version(build_plan(load_spec(data_folder("configs") / described["config"])))}


def _versions(sessions: Iterable[Mapping[str, Any]]) -> set[str]:
    """The code versions of runs; those of older ones were the same for all estimators."""
    found = [session["code_version"] for session in sessions]
    return {version for one in found for version in ([one] if isinstance(one, str) else one.values())}


def read_tables(file: Path) -> list[Row]:
    """Read tables that ``ctid table --format csv`` wrote."""
    try:
        with file.open(encoding="utf-8-sig", newline="") as stream:
            reader = csv.DictReader(stream)
            missing = [name for name in NEEDED if name not in (reader.fieldnames or ())]
            if missing:
                advice = "write such a file with: ctid table --format csv"
                raise UsageError(f"{file} has no column {', '.join(missing)}; {advice}")
            return [_checked_row(line, f"{file}:{reader.line_num}") for line in reader]
    except OSError as error:
        raise UsageError(f"{file} cannot be read: {error.strerror or error}") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise UsageError(f"{file} is not a comma-separated text file: {error}") from None


def _checked_row(line: dict[str, str], place: str) -> Row:
    line.pop(None, None)  # type: ignore[call-overload]  # fields beyond the last column
    row = plain_row(line)
    n, converged = row["n"], row["converged"]
    # An empty field is a cell without a success rule.
    judged = line["converged"] not in (None, "")
    if n is None or (judged and not (converged is not None and 0 <= converged <= n)):
        given = f"not {line['n']!r} and {line['converged']!r}"
        raise UsageError(f"{place}: n and converged must be counts with 0 <= converged <= n, {given}")
    return row


def plain_row(row: Mapping[str, Any]) -> Row:
    """A row in which values are the same whether they come from a CSV file or from results."""
    plain = {key: _plain(value) for key, value in row.items()}
    for key in ("n", "failed", "converged"):
        value = plain.get(key)
        plain[key] = int(value) if isinstance(value, float) and value.is_integer() else None
    # Names stay what they are, also where they look like numbers.
    return plain | {key: row[key] for key in ("table", "experiment", "method")}


def _plain(value: Any) -> Any:
    if value is None or value == "":
        return None
    if isinstance(value, list | dict):
        return json.dumps(value)
    try:
        return str(value) if isinstance(value, bool) else float(value)
    except ValueError:
        return str(value)
