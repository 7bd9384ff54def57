"""Publication of a study: tables, figures, claims, and the environment that made them, from one commit."""

import json
import subprocess
from pathlib import Path

import pandas as pd

from ctid_cli.custom_code import DATA
from ctid_cli.errors import RefusedError, UsageError
from ctid_cli.reporting.document import Section, render_markdown
from ctid_cli.running.plan import build_plan, current_version
from ctid_cli.specification.load import spec_from_canonical
from ctid_cli.storage.status import public_sessions
from ctid_cli.studies.catalogue import StudyFigure, StudyResults
from ctid_cli.studies.claims import CheckedClaims
from ctid_cli.written_files import write_file


def commit_of(found: StudyResults) -> str:
    """Return the commit of this repository that computed all results of a study; refuse any others."""
    changed = _git("status", "--porcelain", "--", ".", ":(exclude)results/published")
    if changed:
        raise RefusedError(f"nothing is published from files that are not committed:\n{changed}")
    for short, results in found.experiments.items():
        if results.stored.mixed:
            raise RefusedError(f"{results.experiment} mixes results of different code versions or processors")
        # Code that a specification names is searched next to it.
        folder = found.study.config(short).parent
        present = current_version(build_plan(spec_from_canonical(results.settings, folder)))
        if not {origin.code_version for origin in results.stored.origins} <= {present}:
            other = f"{results.experiment} was not computed by the code that is checked out"
            raise RefusedError(f"{other}; check out the commit that computed it, or run it again with --fresh")
    origins = [origin for results in found.experiments.values() for origin in results.stored.origins]
    if len({(origin.platform, origin.packages) for origin in origins}) > 1:
        raise RefusedError(f"the experiments of {found.study.name} were computed on different platforms")
    return _git("rev-parse", "HEAD")


def _git(*arguments: str) -> str:
    root = DATA
    # An installed package may be in a folder of another repository.
    if not (root / ".git").exists():
        raise UsageError(f"results are published from a checkout of the repository, and {root} is none")
    try:
        done = subprocess.run(["git", "-C", root, *arguments], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError) as error:
        raise UsageError(f"git {arguments[0]} fails in {root}: {getattr(error, 'stderr', '') or error}") from error
    return done.stdout.strip()


def published_texts(found: StudyResults) -> dict[str, str]:
    """Return the published tables and numbers of a study, by file name."""
    texts, tables = {}, found.study.module("tables")
    for file, name in found.study.texts.items():
        made = getattr(tables, name)(found)
        texts[file] = made if isinstance(made, str) else f"{render_markdown(made)}\n"
    for file, item in found.study.numbers.items():
        shorts = [short for short in item.get("experiments", found.experiments) if short in found]
        rows = [getattr(tables, item["rows"])(found[short]) for short in shorts]
        frame = pd.concat(rows, ignore_index=True) if rows else pd.DataFrame()
        # To 6 digits: a published file must not change with the last bit of a sum.
        rounded = frame.map(lambda value: float(f"{value:.6g}") if isinstance(value, float) else value)
        texts[file] = rounded.to_csv(index=False, columns=item.get("columns"), lineterminator="\n")
    return texts


def publish(checked: CheckedClaims, out: Path) -> None:
    """Write all published files of a study, replacing earlier ones."""
    found, target = checked.results, checked.results.study.published
    commit = commit_of(found)
    texts = published_texts(found)
    claims = Section(table=checked.main_table(), notes=[checked.counted])
    texts |= {"claims.md": render_markdown([claims]) + "\n", "claims.csv": checked.write("csv") + "\n"}
    sessions = {short: public_sessions(results.folder) for short, results in found.experiments.items()}
    texts["environment.json"] = json.dumps({"commit": commit, "sessions": sessions}, indent=2) + "\n"
    files = {target / name: text.encode() for name, text in texts.items()}
    for number in found.study.figures:
        files[target / "figures" / f"figure_{number}.svg"] = StudyFigure(found.study, number).svg(out)
    for old in target.rglob("*.*"):
        old.unlink()
    for path, content in files.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        write_file(path, content)
