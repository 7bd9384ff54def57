from __future__ import annotations

import io
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from ctid_cli.errors import UsageError
from ctid_cli.storage import estimates
from ctid_cli.storage.columns import parameter_names
from ctid_cli.storage.estimates import csv_lines, read_estimates, read_stored
from ctid_cli.storage.export import write_runs
from ctid_cli.storage.folder import experiment_folders
from ctid_cli.storage.journal import open_journal
from ctid_cli.storage.manifest import true_values
from ctid_cli.storage.status import experiment_status, find_estimate
from ctid_cli.storage.truth import arrays_of_rows, found_under, satisfied
from tests.storage.made_results import plan_of

MANIFEST = plan_of(5).manifest()
CLOCKS = ["seconds", "cpu_seconds"]


def test_rows_are_sorted_as_the_specification_is_written(place: Path) -> None:
    frame = read_estimates(place)
    assert frame["estimator"].tolist() == ["search"] * 20 + ["known"] * 10
    assert frame["snr_db"].tolist()[:20] == [10.0] * 10 + [20.0] * 10
    assert frame["replicate"].tolist()[:10] == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4]
    assert frame["start"].tolist()[:2] == ["0.2", "uniform(0, 1)"]
    assert frame["initial_delay"].tolist()[:2] == [0.2, "random"]
    assert (frame["true_delay"] == 0.35).all()
    expected = (frame["delay"] - 0.35).abs() <= 0.2 * 0.35
    assert frame["converged"].tolist() == expected.tolist()
    assert set(frame["converged"]) == {True, False}
    assert frame.attrs["units"]["delay"] == "s"
    assert list(read_estimates(place, ["status", "snr_db"])) == ["status", "snr_db"]


def test_estimates_are_the_same_from_journal_and_export_and_need_one_of_them(place: Path) -> None:
    whole = read_estimates(place)
    assert whole[CLOCKS].drop_duplicates().to_numpy().tolist() == [
        [0.25, 0.125],
        [0.25, pytest.approx(np.nan, nan_ok=True)],
    ]
    whole_status = experiment_status(place)
    alone = Path(shutil.copytree(place, place.parent / "alone"))
    (alone / "journal.sqlite").unlink()
    (place / "runs.h5").write_bytes(b"damaged")
    pd.testing.assert_frame_equal(read_estimates(place), whole)
    assert experiment_status(place) == whole_status
    assert read_estimates(alone)[CLOCKS].isna().all(axis=None)
    pd.testing.assert_frame_equal(read_estimates(alone).drop(columns=CLOCKS), whole.drop(columns=CLOCKS))
    status = experiment_status(alone)
    assert (status.planned, status.done, status.failed, status.left_aside) == (30, 30, 6, None)


def test_what_a_plan_does_not_ask_for_is_set_aside_and_what_it_lacks_is_missing(place: Path) -> None:
    log = open_journal(place / "journal.sqlite")
    for runs, counts in ((2, (12, 12, 18)), (6, (36, 30, 0))):
        log.replan(plan_of(runs).manifest())
        status = experiment_status(place)
        assert (status.planned, status.done, status.left_aside) == counts
        assert len(read_estimates(place)) == counts[1]
    assert [group.todo for group in status.groups] == [2, 2, 1, 1]
    assert status.groups[1].swept == {"snr_db": 20.0}
    log.close()


def test_two_names_share_their_estimates(place: Path) -> None:
    again = {**MANIFEST, "estimators": [*MANIFEST["estimators"], MANIFEST["estimators"][1] | {"name": "again"}]}
    log = open_journal(place / "journal.sqlite")
    log.replan(again)
    assert (experiment_status(place).done, write_runs(place, log)[0]) == (40, 40)
    log.close()
    frame = read_estimates(place)
    assert frame["estimator"].value_counts().to_dict() == {"search": 20, "known": 10, "again": 10}
    assert frame["seconds"].notna().all()
    (place / "journal.sqlite").unlink()
    assert experiment_status(place).done == 40


def test_an_estimate_is_found_by_the_beginning_of_its_id(place: Path) -> None:
    wanted = read_estimates(place).iloc[7]
    found = find_estimate(place.parent, wanted["id"][:8])
    (row,), slot = found.rows(), found.slot(0)
    assert (row["id"], row["delay"], row["seconds"], row["start"]) == (
        *(wanted["id"], wanted["delay"], 0.25, wanted["start"]),
    )
    assert (slot.key.id, slot.estimator["kind"]) == (wanted["id"], "td_srivc")
    assert slot.cell["content"]["noise"]["snr_db"] == 10.0
    with pytest.raises(UsageError, match="30 estimates"):
        find_estimate(place.parent, "")
    with pytest.raises(UsageError, match=r"no id in .* begins with 'xyz'"):
        find_estimate(place.parent, "xyz")


def test_folders_without_results_and_with_odd_names(place: Path, tmp_path: Path) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    # State left by a run that was killed before planning.
    for make in (lambda: None, lambda: open_journal(empty / "journal.sqlite").close()):
        make()
        for read in (read_estimates, experiment_status):
            with pytest.raises(UsageError, match="no results"):
                read(empty)
    odd = Path(shutil.copytree(place, tmp_path / "Ergebnisse für #1 100%?" / "toys"))
    odd.chmod(0o555)
    assert len(read_estimates(odd)) == 30
    odd.chmod(0o755)
    assert experiment_folders(odd.parent) == [odd]
    assert experiment_folders(tmp_path / "nowhere") == []


def test_rows_are_read_some_at_a_time(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stored = read_stored(place)
    rows, columns = list(stored), {name: stored.column(name) for name in ("status", "delay")}
    monkeypatch.setattr("ctid_cli.storage.estimates.ROWS", 7)
    some = read_stored(place).chosen(np.arange(30) % 3 == 1)
    assert list(some) == rows[1::3]
    assert (
        [row["status"] for row in some.rows("status")]
        == some.values("status")
        == columns["status"][1::3].astype(str).tolist()
    )
    assert np.array_equal(some.column("delay"), columns["delay"][1::3], equal_nan=True)
    assert some.converged is not None
    assert some.converged.tolist() == [row["converged"] for row in rows[1::3]]
    assert (len(some.part(0, 0)), list(some.part(0, 0))) == (0, [])


def row(status: str = "CONVERGED", delay: float | None = 8.0, fit: float | None = 95.0) -> dict[str, Any]:
    return {"status": status, "delay": delay, "fit_percent": fit}


DELAY, FIT, PARAMETERS = {"delay_relative_error": 0.01}, {"fit_percent": 90.0}, {"parameter_relative_error": 0.1}
TRUE = {"g1_a1": 0.25, "g1_b0": -3.0, "delay": 8.0}
FRACTION = {"b0": 2.0, "a1": 3.0, "a2": 4.0, "delay": 1.0}


def submodel(status: str = "CONVERGED", **parameters: float | None) -> dict[str, Any]:
    return row(status) | {"parameters": parameters or None}


@pytest.mark.parametrize(
    ("estimate", "success", "truth", "expected"),
    [
        (row(delay=8.079), DELAY, TRUE, True),
        (row(delay=8.081), DELAY, TRUE, False),
        (row("MAX_ITERATIONS", delay=7.93), DELAY, TRUE, True),
        (row("FAILED", delay=8.0), DELAY, TRUE, False),
        (row("TIMEOUT"), FIT, {}, False),
        (row(fit=89.9), FIT, {}, False),
        (row(fit=90.0), FIT, {}, True),
        (row(delay=9.0), DELAY | FIT, TRUE, False),
        (row(), DELAY | {"fit_percent": None}, {}, None),
        (row(), None, TRUE, None),
        (submodel("MAX_ITERATIONS", g1_a1=0.27, g1_b0=-3.2, g1_b1=9.0), PARAMETERS, TRUE, True),
        (submodel(g1_a1=0.28, g1_b0=-3.2), PARAMETERS, TRUE, False),
        (submodel(g1_a1=0.25, g1_b0=None), PARAMETERS, TRUE, False),
        (submodel(), PARAMETERS, TRUE, False),
        (submodel(g1_a1=0.25, g1_b0=-3.0), PARAMETERS | {"fit_percent": 96.0}, TRUE, False),
        (submodel(g1_a1=0.25, g1_b0=-3.0), PARAMETERS, {"delay": 0.0}, None),
        (row() | {"numerator": [2.1], "denominator": [1.0, 2.9, 4.0]}, PARAMETERS, FRACTION, True),
        (row() | {"numerator": [2.1], "denominator": [1.0, 2.5, 4.0]}, PARAMETERS, FRACTION, False),
        (row() | {"numerator": [2.1], "denominator": [1.0, 2.9]}, PARAMETERS, FRACTION, False),
        (row() | {"numerator": [9.0, 2.1], "denominator": [1.0, 2.9, 4.0]}, PARAMETERS, FRACTION, True),
    ],
)
def test_success_rule(
    estimate: dict[str, Any], success: dict[str, Any] | None, truth: dict[str, float], expected: bool | None
) -> None:
    arrays = arrays_of_rows([estimate])
    hits = satisfied(success, truth, arrays, found_under(tuple(truth), arrays, 1).values, None)
    assert (None if hits is None else hits.tolist()) == (None if expected is None else [expected])


def test_true_values_are_those_of_the_estimated_form() -> None:
    submodels = [{"numerator": [2.0], "denominator": [0.1, 1.0]}, {"numerator": [3.0], "denominator": [2.0, 1.0]}]
    # Monic, and sums of submodels by ascending natural frequency.
    fraction = {"numerator": [0, 2.0], "denominator": [0.25, 0.7, 1.0], "delay": 8.0}
    assert true_values({"content": {"system": fraction}}) == {"a1": 2.8, "a2": 4.0, "b0": 8.0, "delay": 8.0}
    sum_of_two = {"additive": submodels, "delay": 0.0}
    assert true_values({"content": {"system": sum_of_two}}) == {
        "g1_a1": 2.0,
        "g1_b0": 3.0,
        "g2_a1": 0.1,
        "g2_b0": 2.0,
        "delay": 0.0,
    }
    own = {"kind": "./tank.py:Tank", "area": 2.0, "truth": {"outflow": 0.4}}
    assert true_values({"content": {"system": own}}) == {"outflow": 0.4}
    assert true_values({"content": {"data": {}}}) == {}


def test_csv_has_one_number_in_a_cell(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = "".join(csv_lines(read_stored(place)))
    flat = pd.read_csv(io.StringIO(whole))
    assert {"b0", "a1", "se_b0", "se_delay", "delay", "converged", "snr_db"} <= set(flat)
    assert not {"numerator", "denominator", "standard_errors", "a0"} & set(flat)
    assert flat["a1"].tolist()[:4] == pytest.approx([2.0, 2.0, 2.0 + 1 / 3, 2.0 + 1 / 3])
    monkeypatch.setattr(estimates, "ROWS", 7)
    assert "".join(csv_lines(read_stored(place))) == whole


def test_names_of_parameters_have_one_order() -> None:
    found = [{"x": 1.0, "delay": 1.0, "g2_a1": 1.0, "a2": 1.0}, None, {"b1": 1.0, "a1": 1.0, "g1_b0": 1.0, "b0": 1.0}]
    assert parameter_names(found) == ["b0", "b1", "a1", "a2", "g1_b0", "g2_a1", "delay", "x"]
