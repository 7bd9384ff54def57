"""Custom components in a specification: errors are reported with their place, without a traceback."""

import sys

import numpy as np
import pytest

from ctid_cli.custom_code import STUDIES, find_class, is_shipped
from ctid_cli.errors import RefusedError
from ctid_cli.running.plan import build_plan
from ctid_cli.specification.load import load_spec, spec_from_canonical
from tests.specification.written import CUSTOM as SPEC
from tests.specification.written import CUSTOM_PARTS as CODE
from tests.specification.written import SIGNAL, changed
from tests.specification.written import load as load_text


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "parts.py").write_text(CODE, encoding="utf-8")
    (tmp_path / "gains.py").write_text("GAIN = 2.0\n", encoding="utf-8")
    (tmp_path / "spec.yaml").write_text(SPEC, encoding="utf-8")
    return tmp_path


def edited(folder, file, old, new):
    path = folder / file
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")


def load(folder):
    return load_spec(folder / "spec.yaml", allow_code=True)


def test_options_are_swept_validated_and_canonical(folder):
    spec = load(folder)
    plan = build_plan(spec)
    assert len(plan.data_cells) == 4
    first = plan.estimators[0]
    assert first.estimator.options.bounds == (0.0, 1.0)
    assert first.estimator.options.inner.size == 2.0
    assert [cell.swept for cell in plan.estimators] == [{"cutoff": 1.0}, {"cutoff": 2.0}, {}]
    assert [start.label for _, cell, start in plan.keys(0, 0) if cell is first] == [
        "0.3",
        "uniform(0.2, 0.5)",
    ]
    # The name of an option stands for its value.
    truths = [cell.content["system"]["truth"] for cell in plan.data_cells]
    assert truths == [{"area": area, "b0": 0.5} for area in (1.0, 1.0, 2.0, 2.0)]
    again = build_plan(spec_from_canonical(spec.canonical(), folder, allow_code=True))
    assert [cell.hash for cell in again.data_cells] == [cell.hash for cell in plan.data_cells]
    assert [cell.hash for cell in again.estimators] == [cell.hash for cell in plan.estimators]


def test_nothing_is_imported_without_permission(folder):
    edited(folder, "parts.py", "GAIN\n", 'GAIN\nraise SystemExit("imported")\n')
    canonical = {"experiment": "x", "estimators": {"a": {"kind": "parts:X"}}}
    with pytest.raises(RefusedError, match=r"spec.yaml:2:21: system.kind: names code(.|\n)*spec.yaml:8:11"):
        load_spec(folder / "spec.yaml")
    with pytest.raises(RefusedError, match="--allow-code"):
        spec_from_canonical(canonical)


def test_a_noise_may_ask_for_the_instants(folder):
    edited(folder, "parts.py", "generate(self, output, rng)", "generate_at(self, times, output, rng)")
    edited(folder, "parts.py", "return GAIN * self.deviation * rng", "return times + 0 * GAIN * rng")
    record = build_plan(load(folder)).data_cells[0].dataset(0).record
    np.testing.assert_allclose(record.y, record.noise_free + record.t)


def test_a_class_with_a_fitting_fit_alone_is_an_estimator(folder):
    edited(folder, "parts.py", "class Estimator(Base)", "class Estimator")
    assert build_plan(load(folder)).estimators[0].estimator.start_from == "delay"
    (folder / "parts.py").write_text(CODE + "class Plain:\n    def fit(self, record, start):\n        return {}\n")
    edited(folder, "spec.yaml", "./parts.py:Estimator\n    order: 2\n    cutoff: [1.0, 2.0]", "./parts.py:Plain")
    edited(folder, "spec.yaml", "    mode: slow\n    bounds: [0, 1]\n    names: [a1, b0]\n    inner: {size: 2.0}\n", "")
    assert build_plan(load(folder)).estimators[0].content == {"kind": "./parts.py:Plain"}


def test_every_folder_has_neighbours_of_its_own(folder, tmp_path_factory):
    other = tmp_path_factory.mktemp("other")
    (other / "inner").mkdir()
    files = {
        "gains.py": "GAIN = 3.0\n",
        "inner/__init__.py": "from .deep import DEEP\n",
        "inner/deep.py": "import gains\nDEEP = 2 * gains.GAIN\n",
        "parts.py": "from inner import deep, DEEP\nimport inner.deep\n"
        "class A:\n    def f():\n        from gains import GAIN\n"
        "        return GAIN, DEEP, deep.DEEP, inner.deep.DEEP\n",
    }
    for name, text in files.items():
        (other / name).write_text(text, encoding="utf-8")
    first, second = find_class("./parts.py:Noise", folder), find_class("./parts.py:A", other)
    assert (first.generate.__globals__["GAIN"], second.f()) == (2.0, (3.0, 6.0, 6.0, 6.0))
    # The same file with other content is another module, also when imported by an unchanged module.
    edited(folder, "gains.py", "2.0", "4.0")
    after = find_class("./parts.py:Noise", folder)
    assert [c.generate.__globals__["GAIN"] for c in (first, after)] == [2.0, 4.0]
    assert "gains" not in sys.modules


WINDOW = "{kind: drem_window, tones: 2, h: 0.7, d: 0.4, memory: 4}"


def test_only_the_code_of_shipped_studies_runs_without_permission(tmp_path):
    comparators = STUDIES / "finite_time_frequency" / "comparators"
    kind = "{kind: '%s/whole_record.py:Esprit', tones: 2, averaging: 0.05}"
    assert load_text(tmp_path, changed(SIGNAL, (WINDOW, kind % comparators))).warnings
    # Imports of a linked file would be resolved next to the link.
    (tmp_path / "whole_record.py").symlink_to(comparators / "whole_record.py")
    for place in (".", f"{comparators}/../../../tests"):
        with pytest.raises(RefusedError, match="--allow-code"):
            load_text(tmp_path, changed(SIGNAL, (WINDOW, kind % place)))
    (tmp_path / "link").symlink_to(comparators)
    assert not is_shipped("link/../whole_record.py:Esprit", tmp_path)
    assert not is_shipped("package.module:Class", tmp_path)
