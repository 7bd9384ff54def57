"""Page of a reproduced study: question, claims, tables and figures, from its results or as published."""

from collections.abc import Iterator
from pathlib import Path

import ctid_cli
from ctid_cli.errors import UsageError
from ctid_cli.reporting.document import Section, Table
from ctid_cli.reporting.pages.experiment_page import experiment_page
from ctid_cli.reporting.pages.page import Chapter, sections_of, shown, write_page
from ctid_cli.reporting.results import experiments_in, out_option, read_results
from ctid_cli.reporting.study import Study, all_studies
from ctid_cli.reporting.study_table import environment_of
from ctid_cli.studies.catalogue import StudyFigure, read_study
from ctid_cli.studies.claims import check_claims
from ctid_cli.studies.publishing import published_texts
from ctid_cli.text import count, did_you_mean

CLAIMS = "claims.md"


def page_of(name: str, out: Path) -> tuple[str, Path]:
    """Return the page of an experiment or a study, and its default path."""
    known, studies = experiments_in(out), all_studies()
    if name in known:
        results = read_results(out, name)
        # Pages are sent to others, so their commands name no folder of this machine.
        return experiment_page(results, Path(shown(str(out)))), results.folder / "report.html"
    if name in studies:
        return study_page(studies[name], out), out / f"{studies[name].folder.name}_report.html"
    hint = did_you_mean(name, [*known, *studies]) or "."
    wrong = f"{name!r} is neither an experiment with results in the folder {out} nor a study{hint}"
    raise UsageError(f"{wrong} Known: {', '.join([*known, *studies])}")


def study_page(study: Study, out: Path) -> str:
    """Return the page as HTML: from a results folder if all experiments were run there, else as published."""
    published = study.published
    own = set(study.configs) <= set(experiments_in(out))
    if own:
        texts = {name: text for name, text in published_texts(read_study(study, out)).items() if name.endswith(".md")}
        claims = list(check_claims(read_study(study, out)).sections())
        origin = [f"Results in {out.name}: {', '.join(study.configs)}."]
    else:
        texts = {file.name: file.read_text(encoding="utf-8") for file in sorted(published.glob("*.md"))}
        claims = sections_of(texts.pop(CLAIMS)) if CLAIMS in texts else []
        origin = list(_published_origin(published))
    cited = f" {study.citation}." if study.citation else ""
    again = [
        f"- to compute it again: `ctid reproduce {study.name}`",
        f"- to check it: `ctid reproduce --check {study.name}`",
    ]
    chapters = [
        Chapter("Question", list(_question(study))),
        Chapter("Claims", claims),
        Chapter("Tables", [section for text in texts.values() for section in sections_of(text)]),
        Chapter("Figures", list(_figures(study, out, published, own=own))),
        Chapter("Provenance", [Section(sentences=[*origin, *again])]),
        Chapter("How to cite", [Section(sentences=[f"ctid {ctid_cli.__version__}, study {study.name}.{cited}"])]),
    ]
    after = f", after{cited}" if cited else "."
    return write_page(study.title, f"The study {study.name} of ctid {ctid_cli.__version__}{after}", chapters)


def _question(study: Study) -> Iterator[Section]:
    if study.success:
        yield Section(sentences=[f"Counted: {study.success}."])
    if study.methods:
        yield Section(table=Table.of_lines(["method", "what it does"], study.methods.items()))
    rows = [(name, f"configs/{config}") for name, config in study.configs.items()]
    yield Section(table=Table.of_lines(["experiment", "specification"], rows))


def _figures(study: Study, out: Path, published: Path, *, own: bool) -> Iterator[Section]:
    """Yield its figures as published, or from its own results."""
    for number, needed in study.figures.items():
        file = published / "figures" / f"figure_{number}.svg"
        drawn = own and bool(needed)
        if drawn or file.is_file():
            figure = StudyFigure(study, number)
            svg = figure.svg(out) if drawn else file.read_bytes()
            caption = f"Figure {number}. {figure.caption}" if number.isdigit() else figure.caption
            command = f"ctid figure {study.name}/{number}{out_option(out)}"
            yield Section(drawing=svg, caption=f"{caption}. `{command}`")


def _published_origin(published: Path) -> Iterator[str]:
    """Yield the origin of the published results, in sentences."""
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
