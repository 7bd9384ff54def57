"""Custom estimators of frequencies in a specification: what is refused, and whose code runs without permission."""

import pytest

from ctid_cli.custom_code import STUDIES, is_shipped
from ctid_cli.errors import RefusedError, SpecError
from tests.specification.written import SIGNAL, changed, load

CODE = """\
from dataclasses import dataclass
import numpy as np
from ctid_cli import DataError, FrequencyEstimator, FrequencyTrack

@dataclass(frozen=True, kw_only=True)
class Constant(FrequencyEstimator):
    value: float = 2.0
    def check(self, count, interval):
        if self.value > 9.0:
            raise DataError("value is too large", "value")
    def track(self, samples, interval):
        t = interval * np.arange(samples.size)
        return FrequencyTrack(t, np.full((t.size, self.tones), self.value), np.zeros(t.size, np.uint16))

class Other:
    def fit(self, record, start):
        return {}

class NoDataclass(FrequencyEstimator):
    value: float = 2.0
    def track(self, samples, interval):
        pass
"""
WINDOW = "{kind: drem_window, tones: 2, h: 0.7, d: 0.4, memory: 4}"


def said(folder, estimator):
    (folder / "mine.py").write_text(CODE, encoding="utf-8")
    text = changed(SIGNAL, (WINDOW, estimator))
    try:
        load(folder, text, allow_code=True)
    except SpecError as error:
        return [f"{problem.key}: {problem.message}" for problem in error.problems]
    return []


@pytest.mark.parametrize(
    ("estimator", "message"),
    [
        ("{kind: './mine.py:Constant', tones: 2}", None),
        ("{kind: './mine.py:Constant', tones: 3}", "estimators.window.tones: must be 2"),
        ("{kind: './mine.py:Constant', tones: 2, value: [3, 10]}", "estimators.window.value: value is too large (with"),
        ("{kind: './mine.py:Other'}", "Other is no ctid_cli.FrequencyEstimator; derive it from that, with track(self"),
        ("{kind: './mine.py:NoDataclass', tones: 2}", "NoDataclass is no dataclass; write @dataclass(frozen=True)"),
    ],
)
def test_what_is_refused(tmp_path, estimator, message):
    found = said(tmp_path, estimator)
    assert found == [] if message is None else [text for text in found if message in text]


def test_only_the_code_of_shipped_studies_runs_without_permission(tmp_path):
    comparators = STUDIES / "finite_time_frequency" / "comparators"
    kind = "{kind: '%s/whole_record.py:Esprit', tones: 2, averaging: 0.05}"
    assert load(tmp_path, changed(SIGNAL, (WINDOW, kind % comparators))).warnings
    # A link to the file would have its neighbours looked for beside the link.
    (tmp_path / "whole_record.py").symlink_to(comparators / "whole_record.py")
    for place in (".", f"{comparators}/../../../tests"):
        with pytest.raises(RefusedError, match="--allow-code"):
            load(tmp_path, changed(SIGNAL, (WINDOW, kind % place)))
    (tmp_path / "link").symlink_to(comparators)
    assert not is_shipped("link/../whole_record.py:Esprit", tmp_path)
    assert not is_shipped("package.module:Class", tmp_path)
