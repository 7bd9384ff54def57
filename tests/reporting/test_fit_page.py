"""Page of a fit: self-contained, and safe for any names of files and columns."""

import re
import shlex
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from ctid_cli import DelayProfile, HeldSignal, Record, TransferFunction, identify, simulate
from ctid_cli.reporting.fit_result import FitResult
from ctid_cli.reporting.pages.page import bibtex
from ctid_cli.reporting.records import Records
from ctid_cli.signals.measurement import Measurement
from ctid_cli.storage.fit_file import read_fit
from tests.reporting.parsed_page import alone

HOSTILE = "<script>alert(1)</script>&$x_{$\"'"
SYSTEM = TransferFunction([3.0], [1.0, 1.2, 4.0], 0.73)


def measurement(seed, name, n=400, noise=0.1):
    rng = np.random.default_rng(seed)
    t = 0.1 * np.arange(n)
    u = HeldSignal(t, np.repeat(rng.choice([-1.0, 1.0], n // 5), 5))
    y = simulate(SYSTEM, u, t) + noise * rng.standard_normal(n)
    return Measurement(Record(t, y, u, name=name), "s", HOSTILE, "mm", "t", HOSTILE, HOSTILE, notes=(HOSTILE,))


@pytest.fixture(scope="module")
def fitted():
    """Return a fit with all optional parts, its records and its page."""
    measured, other = [measurement(0, HOSTILE)], measurement(1, "other.csv")
    options = DelayProfile(2, 0, (0, 2), initial_state="estimate", offset="estimate")
    result = identify([item.record for item in measured], options, other.record)
    return result, measured, other


def page_of(result, measured, other, folder):
    found = FitResult(result, Records(measured, other))
    path = folder / "fit.json"
    command = shlex.join(["ctid", "fit", HOSTILE, "/far/away.csv"])
    path.write_text(found.file_text(folder, command), encoding="utf-8")
    stored = read_fit(path)
    again = FitResult(stored.result, Records(measured, other))
    return found.page(stored.content), again.page(stored.content)


def test_a_page_says_all_and_needs_nothing_but_itself(fitted, tmp_path):
    text, again = page_of(*fitted, tmp_path)
    assert text == again  # the page of the stored fit is identical
    page = alone(text)
    titles = ["Warnings", "Data", "Model", "Output", "Responses", "Poles", "Delay", "Provenance"]
    fine = "The search ended well, the residuals pass their tests, and no change that was tried gives a better fit."
    assert all(title in page.text for title in [*titles, "How to cite", fine])
    assert page.tags["svg"] == 7
    assert not fitted[0].warnings
    for words in ("natural_frequency_1", "95 % low", "without a model", "cost above the least", "@software{ctid"):
        assert words in page.text or words in text
    assert page.text.count(HOSTILE) >= 5  # title, columns, note, units
    assert shlex.join(["ctid", "fit", HOSTILE, "away.csv"]) in page.text


def test_nothing_of_the_machine_is_on_the_page(fitted, tmp_path):
    result, measured, _ = fitted
    file = tmp_path / "far" / "r.csv"
    file.parent.mkdir()
    file.write_text("t,u,y\n", encoding="utf-8")
    moved = [replace(measured[0], path=file)]
    (tmp_path / "near").mkdir()
    found = FitResult(replace(result, validation=None), Records(moved))
    (tmp_path / "near" / "fit.json").write_text(found.file_text(tmp_path / "near"), encoding="utf-8")
    page = found.page(read_fit(tmp_path / "near" / "fit.json").content)
    assert "r.csv, hold zoh" in page
    assert str(tmp_path) not in page


@pytest.mark.slow
def test_a_known_delay_and_a_model_of_nothing_have_pages_too(tmp_path):
    rng = np.random.default_rng(3)
    t = 0.1 * np.arange(200)
    record = Record.from_arrays(t, np.repeat(rng.choice([-1.0, 1.0], 40), 5), rng.standard_normal(200), name="noise")
    measured = [Measurement.of(record)]
    result = identify([record], DelayProfile(1, 0, (0.5, 0.5)))
    text, again = page_of(result, measured, None, tmp_path)
    assert text == again
    assert '<section id="delay">' not in text
    assert "no answer" in alone(text).text.lower()


def test_what_a_fit_used_is_cited(fitted):
    result = FitResult.of(fitted[0])
    entries = bibtex(*result.cited())
    assert entries.count("{") == entries.count("}")
    keys = re.findall(r"^@\w+\{(\w+),$", entries, re.MULTILINE)
    assert keys == ["kaufman1975", "pintelon2012"]
    noisy = replace(result, fitted=replace(fitted[0], fit=replace(fitted[0].fit, noise=SimpleNamespace())))
    assert bibtex(*noisy.cited()).count("hausman1978") == 1
