"""The page of a reproduced study: its question, claims, tables and figures, from its results or as published."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import ctid_cli
from ctid_cli.errors import UsageError
from ctid_cli.reporting.committed import environment_of, made_by
from ctid_cli.reporting.layout import Report, Table, count
from ctid_cli.reporting.pages.page import inline, report_of, written
from ctid_cli.reporting.results import experiments_in, out_option
from ctid_cli.reporting.study import study_contents
from ctid_cli.studies.catalogue import StudyFigure, StudyFolder, published_folder, read_study
from ctid_cli.studies.claims import check_claims
from ctid_cli.studies.publishing import published_texts

CLAIMS = "claims.md"


def study_page(study: StudyFolder, out: Path) -> str:
    """The page as HTML: of the results in a folder where all experiments were run, else of what is published."""
    published = published_folder(study)
    own = set(study.configs) <= set(experiments_in(out))
    if own:
        found = read_study(study, out)
        texts = {name: text for name, text in published_texts(found).items() if name.endswith(".md")}
        texts[CLAIMS] = check_claims(study, out).write("md")
        origin = [f"Results in {out.name}: {', '.join(study.configs)}."]
    elif published.is_dir():
        texts = {file.name: file.read_text(encoding="utf-8") for file in sorted(published.glob("*.md"))}
        origin = list(_published_origin(published, study.name))
    else:
        command = f"ctid reproduce {study.name}{out_option(out)}"
        raise UsageError(f"an installed package does not hold the results of {study.name}; run first: {command}")
    # Claims that the tables already state are there once.
    claims = texts.pop(CLAIMS, None)
    source = study_contents()[study.name].get("source")
    cited = f"{source['authors']}: {source['title']} ({source['identifier']})" if source else ""
    return written(
        "study.html",
        title=study.title,
        version=ctid_cli.__version__,
        lead=f"The study {study.name} of ctid {ctid_cli.__version__}" + (f", after {cited}." if cited else "."),
        question=_question(study),
        claims=report_of(claims) if claims else None,
        reports=[report_of(text) for text in texts.values()],
        figures=list(_figures(study, out, published, own=own)),
        provenance=[
            *origin,
            f"To compute it again: ctid reproduce {study.name}; to check it: ctid reproduce --check {study.name}",
        ],
        cite=f"ctid {ctid_cli.__version__}, study {study.name}." + (f" {cited}." if cited else ""),
    )


def _question(study: StudyFolder) -> Report:
    content = study_contents()[study.name]
    blocks: list[list[str | Table]] = []
    if content.get("success"):
        blocks.append([f"Counted: {content['success']}."])
    if content.get("methods"):
        blocks.append([Table(["method", "what it does"], [[*item] for item in content["methods"].items()], "ll")])
    rows = [[name, f"configs/{config}"] for name, config in study.configs.items()]
    return Report([*blocks, [Table(["experiment", "specification"], rows, "ll")]])


def _figures(study: StudyFolder, out: Path, published: Path, *, own: bool) -> Iterator[dict[str, Any]]:
    """Its figures as published, but for those that its own results have."""
    for number, needed in study.figures.items():
        file = published / "figures" / f"figure_{number}.svg"
        drawn = own and bool(needed)
        if drawn or file.is_file():
            figure = StudyFigure(study, number)
            svg = figure.svg(out) if drawn else file.read_bytes()
            caption = f"Figure {number}. {figure.caption}" if number.isdigit() else figure.caption
            command = f"ctid figure {study.name}/{number}{out_option(out)}"
            yield {"svg": inline(svg, f"figure-{number}"), "caption": caption, "command": command}


def _published_origin(published: Path, study: str) -> Iterator[str]:
    """What made the published results."""
    environment = environment_of(published)
    if environment is None:
        return
    sessions = [session for own in environment["sessions"].values() for session in own]
    computed = sum(session["computed"] for session in sessions)
    last = max(session["stopped"] or session["started"] for session in sessions)
    made = f"{computed} estimates in {count(len(sessions), 'session')} until {last}"
    yield f"Published from commit {environment['commit']}: {made}."
    packages = sessions[-1]["packages"].items()
    yield "Made with " + ", ".join(f"{name} {version}" for name, version in packages) + "."
    if remark := made_by(published, study):
        yield f"These results were {remark}."
