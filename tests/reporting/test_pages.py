"""Pages: well-formed, self-contained, and safe for any content of messages and files."""

from pathlib import Path

import pandas as pd
import pytest

from ctid_cli.reporting.document import Section, Table, render_markdown, render_text
from ctid_cli.reporting.pages.experiment_page import experiment_page
from ctid_cli.reporting.pages.page import ROWS, Chapter, inline, sections_of, write_page
from ctid_cli.reporting.pages.question import formula_of, polynomial
from ctid_cli.storage.sqlite_file import SPEC
from tests.reporting.parsed_page import Page, alone

HOSTILE = "<script>alert(1)</script> & \"quotes\" 'too' --> {{ 7 * 7 }} {% include 'x' %}"


@pytest.fixture
def results(make_results, estimate, add_estimator, tmp_path):
    right = [estimate(delay) for delay in (8.1, 7.9, 8.05, 8.02)]
    failed = [*right[:3], estimate(None, status="FAILED", message=HOSTILE)]
    found = make_results({(5.0, "0.0"): failed, (15.0, "0.0"): right})
    (tmp_path / SPEC).write_text(f"# {HOSTILE}\nexperiment: hostile\n", encoding="utf-8")
    add_estimator(found, "startless", {(snr, None): right for snr in (5.0, 15.0)})
    return found


@pytest.fixture
def page(results):
    return alone(experiment_page(results, Path("results")))


def test_a_page_says_all_that_it_should(page, results):
    titles = ["Question", "Tables", "Figures", "What went wrong", "Provenance", "How to cite"]
    assert all(title in page.text for title in titles)
    assert page.tags["svg"] == 2
    assert "2 estimators on 8 data sets in 2 settings: 16 estimates, 1 of them failed." in page.text
    assert "percent of the data sets whose delay estimate lies within 1 % of the true delay" in page.text
    failed = next(row["id"] for row in results.stored if row["status"] == "FAILED")
    assert f"ctid export useful-redundancy/case1-regular --id {failed}" in page.text
    assert "Huong Ha" not in page.text  # nobody's method but td_srivc's
    assert "doi:10.1016/j.jprocont.2014.10.003" in page.text


def test_text_of_others_stays_text(page, results):
    assert page.text.count("<script>alert(1)</script>") == 2  # the reason of a failure, and the specification
    assert "{{ 7 * 7 }}" in page.text


def test_long_tables_are_cut_and_say_so():
    frame = pd.DataFrame({"a": range(ROWS + 5)})
    text = Page(write_page("t", "lead", [Chapter("Tables", [Section(table=Table.of_frame(frame))])])).text
    assert f"The first {ROWS} of {ROWS + 5} rows" in text
    assert f"{ROWS - 1}" in text
    assert f"{ROWS + 1}" not in text


def test_drawings_do_not_share_names():
    inside = '<metadata>a</metadata><path id="a"/><use xlink:href="#a" s="url(#a)"/>'
    drawing = f'<?xml version="1.0"?>\n<svg x="1">{inside}</svg>'.encode()
    assert inline(drawing, "f") == (
        '<svg role="img" x="1"><path id="f-a"/><use xlink:href="#f-a" s="url(#f-a)"/></svg>'
    )


def test_equations_are_read_from_the_specification():
    assert polynomial([0.25, -1, 0, 1]) == "0.25 s³ − s² + 1"
    assert polynomial([0.0]) == "0"
    assert polynomial([-1.0, 0.5]) == "−s + 0.5"
    one = {"system": {"numerator": [2], "denominator": [1, 1], "delay": [0.0, 1.0]}}
    assert formula_of(one) == "G(s) = 2 / (s + 1) · e^(−τ s)"
    two = {"system": {"additive": [{"numerator": [1], "denominator": [1, 2], "integrators": 1}] * 2}}
    assert formula_of(two) == "G(s) = 1 / [s (s + 2)] + 1 / [s (s + 2)]"
    assert formula_of({"system": {"kind": "own.py:Tank", "truth": {"k": 1.0}}}) == ""


def test_published_markdown_is_read_back():
    frame = pd.DataFrame({"a | b": ["x", "y"], "n": ["1", "2"]})
    text = render_markdown([Section("Title", ["Some words."], Table.of_frame(frame))])
    title, words, table = sections_of(text)
    assert (title.title, words.sentences) == ("Title", ["Some words."])
    assert table.table.to_frame().equals(frame)


def test_a_table_that_is_too_wide_goes_on_below_with_what_tells_its_rows_apart():
    frame = pd.DataFrame(
        {"SNR": ["5 dB", "", "15 dB"], "start": ["3 s", "7 s", "3 s"], "%": [1, 2, 3], "time": [4, 5, 6]}
    )
    assert render_text([Section(table=Table.of_frame(frame))], 17).splitlines() == [
        *("  SNR  start  %", "---------------", " 5 dB    3 s  1", "         7 s  2", "15 dB    3 s  3", ""),
        *("  SNR  start  time", "------------------", " 5 dB    3 s     4", "         7 s     5", "15 dB    3 s     6"),
    ]
