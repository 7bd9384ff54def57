from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import textwrap
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from ctid_cli.errors import RefusedError, StorageError, UsageError
from ctid_cli.running.engine import run_experiment
from ctid_cli.running.plan import current_origins
from ctid_cli.storage.columns import failed, no_result
from ctid_cli.storage.folder import experiment_folders
from ctid_cli.storage.identity import origin_of
from ctid_cli.storage.journal import open_journal
from ctid_cli.storage.journal_reader import read_journal
from ctid_cli.storage.manifest import slots, true_values
from ctid_cli.storage.sealed import USER_BLOCK
from ctid_cli.storage.store import experiment_status, find_estimate, load_estimates, read_stored
from ctid_cli.storage.summary import export_rows
from tests.running.fakes import FakePlan, Toy
from tests.storage.sealed_images import headed, read_sealed, seal_image

PLAN = FakePlan(Toy("raise", at=1), Toy(order=3))
CLOCKS = ["seconds", "cpu_seconds"]
ORIGIN = origin_of(PLAN.data_cells[0], PLAN.estimators[0].estimator)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("store") / "results" / "toys"
    run_experiment(PLAN, place, jobs=2, warm=lambda plan: None)  # type: ignore[arg-type]
    return place


@pytest.fixture
def place(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "results" / "toys"))


def test_the_sealed_file_holds_what_the_journal_holds(place: Path) -> None:
    with read_journal(place / "journal.sqlite") as log:
        assert log is not None
        journalled = {key: entry.content for key, entry in log.entries().items()}
        assert log.sealed() == read_sealed(place / "runs.h5").checksum
    assert read_sealed(place / "runs.h5").results == journalled


def test_the_sealed_file_explains_itself_to_other_programs(place: Path) -> None:
    with h5py.File(place / "runs.h5") as file:
        assert file.attrs["experiment"] == "toys"
        assert (file.attrs["seed"], file.attrs["runs"], file.attrs["format_version"]) == (7, 6, 1)
        assert file.attrs["code_version"] == ORIGIN.code_version
        assert json.loads(file["spec"].asstr()[()]) == PLAN.spec.canonical()
        assert json.loads(file["manifest"].asstr()[()])["experiment"] == "toys"
        group = file["estimates"]
        status = group["status"].asstr()[()]
        assert status.tolist().count("FAILED") == 4
        first = int(np.argmax(group["estimator"].asstr()[()] == "toy0"))
        length = group["denominator_length"][first]
        assert group["denominator"][first, :length][0] == 1.0
        assert np.isnan(group["denominator"][first, length:]).all()
        assert group["delay"].attrs["unit"] == "s"
        assert set(np.unique(group["swept/level"][()])) == {5.0, 15.5}
        assert group["standard_error_names"].asstr()[()].tolist() == ["b0", "delay"]
        assert group["standard_errors"].attrs["columns"] == "b0, delay"
        assert group["status"].attrs["meaning"] == "how the estimate ended"
        everything: list[str] = []
        file.visit(everything.append)
        assert not [name for name in everything if any(word in name for word in ("second", "time", "host", "session"))]
        attributes = [value for name in ("/", *everything) for value in file[name].attrs.values()]
        assert {type(value) for value in attributes} == {str, np.int64}
        texts = [file[name] for name in everything if getattr(file[name], "dtype", np.dtype("f8")).kind in "SO"]
        assert len(texts) > 5
        assert all(h5py.check_string_dtype(text.dtype).encoding == "utf-8" for text in texts)


def test_the_documented_lines_read_it_with_h5py_and_pandas_alone(place: Path) -> None:
    page = (Path(__file__).parents[2] / "docs" / "machine-readable.md").read_text(encoding="utf-8")
    (lines,) = re.findall(r"^    import json\n(?:    .*\n|\n)+", page, re.MULTILINE)
    code = textwrap.dedent(lines).replace("results/quickstart/runs.h5", "runs.h5")
    told = "import sys; print(experiment, spec['monte_carlo']['seed'], units['delay'], len(estimates))\n"
    told += "print(*sorted(estimates['status'].unique()), [name for name in sys.modules if name.startswith('ctid')])"
    done = subprocess.run([sys.executable, "-c", code + told], stdout=subprocess.PIPE, text=True, cwd=place, check=True)
    rows = read_sealed(place / "runs.h5").results
    assert done.stdout.splitlines() == [f"toys 7 s {len(rows)}", "CONVERGED FAILED []"]


def test_rows_are_sorted_as_the_specification_is_written(place: Path) -> None:
    frame = load_estimates(place)
    assert frame["estimator"].tolist() == ["toy0"] * 24 + ["toy1"] * 12
    assert frame["level"].tolist()[:24] == [5.0] * 12 + [15.5] * 12
    assert frame["replicate"].tolist()[:12] == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5]
    assert frame["start"].tolist()[:2] == ["3", "uniform(0, 9)"]
    assert frame["initial_delay"].tolist()[:2] == [3.0, "random"]
    assert frame["initial_delay"].tolist()[-1] is None
    random_start = frame["start_delay"][1]
    assert 0 <= random_start <= 9
    assert random_start != 3.0
    assert (frame["true_delay"] == 8.0).all()
    assert frame["seconds"].notna().sum() == 32
    expected = (frame["delay"] - 8.0).abs() <= 0.08
    assert frame["converged"].tolist() == expected.tolist()
    assert {True, False} == set(frame["converged"])


def test_estimates_are_the_same_from_the_journal_and_from_the_sealed_file(place: Path) -> None:
    sealed = load_estimates(place)
    (place / "runs.h5").unlink()
    journalled = load_estimates(place)
    assert journalled.drop(columns=CLOCKS).equals(sealed.drop(columns=CLOCKS))
    np.testing.assert_allclose(journalled[CLOCKS], sealed[CLOCKS])
    assert (journalled["cpu_seconds"].dropna() >= 0).all()


def test_the_sealed_file_is_enough(place: Path) -> None:
    complete = load_estimates(place)
    for name in ("journal.sqlite", "timings.csv", "spec.yaml", "spec.canonical.json"):
        (place / name).unlink()
    alone = load_estimates(place)
    assert alone[CLOCKS].isna().all(axis=None)
    assert alone.drop(columns=CLOCKS).equals(complete.drop(columns=CLOCKS))
    status = experiment_status(place)
    assert (status.planned, status.done, status.failed, status.left_aside) == (36, 36, 4, None)


def test_every_flipped_bit_is_found(place: Path) -> None:
    path = place / "runs.h5"
    intact, expected = path.read_bytes(), read_sealed(path)
    rng = np.random.default_rng(5)
    for position in [*range(0, 520, 8), *rng.integers(0, len(intact), 150).tolist()]:
        damaged = bytearray(intact)
        damaged[position] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        with pytest.raises(StorageError, match=r"cannot be read|is damaged"):
            read_sealed(path)
    path.write_bytes(intact[USER_BLOCK:])  # as an older version has written it
    assert read_sealed(path) == expected
    path.write_bytes(intact[: len(intact) // 2])
    with pytest.raises(StorageError, match=r"'ctid run' with the same specification seals them again"):
        load_estimates(place)


def test_a_newer_sealed_format_is_refused(place: Path) -> None:
    (place / "journal.sqlite").unlink()
    path = place / "runs.h5"
    with h5py.File(path, "r+") as file:
        file.attrs["format_version"] = 2
    path.write_bytes(headed(path.read_bytes()[USER_BLOCK:]))
    with pytest.raises(RefusedError, match="format 2; this ctid reads formats up to 1"):
        load_estimates(place)


def test_sealing_extreme_contents_gives_them_back(tmp_path: Path) -> None:
    plan = FakePlan(Toy(), runs=1, levels=(1,))
    manifest = plan.manifest()  # type: ignore[arg-type]
    keys = [slot.key for slot in slots(manifest)]
    odd: dict[str, Any] = no_result() | {
        "status": "CONVERGED",
        "message": "τ̂ = 8\n\tπ",
        "start_delay": 0.0,
        "delay": 5e-324,
        "numerator": [None, -0.0, 1.7976931348623157e308],
        "denominator": [1.0],
        "standard_errors": {},
        "cost": None,
        "fit_percent": -1e300,
        "validation_fit_percent": 0.1,
        "iterations": 0,
        "condition_number": None,
    }
    for results in ({keys[0]: odd, keys[1]: failed("died", "CRASHED")}, {keys[1]: odd}, {}):
        image, checksum, count = seal_image(manifest, [ORIGIN], results)
        (tmp_path / "runs.h5").write_bytes(image)
        read = read_sealed(tmp_path / "runs.h5")
        assert read.results == results
        assert (read.checksum, count) == (checksum, len(results))
        assert read.manifest == manifest
        assert read.origins == (ORIGIN,)


def additive(manifest: dict[str, Any]) -> dict[str, Any]:
    """The same plan for a system of two submodels, the faster one first."""
    submodels = [{"numerator": [2.0], "denominator": [0.1, 1.0]}, {"numerator": [3.0], "denominator": [2.0, 1.0]}]
    cells = [
        cell | {"content": cell["content"] | {"system": {"additive": submodels, "delay": 0.0}}}
        for cell in manifest["data_cells"]
    ]
    return manifest | {"data_cells": cells}


def test_parameters_of_submodels_are_sealed(tmp_path: Path) -> None:
    plan = FakePlan(Toy(), runs=2, levels=(1,))
    plain = plan.manifest()  # type: ignore[arg-type]
    manifest = additive(plain)
    keys = [slot.key for slot in slots(manifest)]
    result = failed("", "CONVERGED") | {"numerator": [1.0], "denominator": [1.0, 2.0], "iterations": 3}
    results = {
        keys[0]: result | {"parameters": {"g1_a1": 2.0, "g1_b0": 3.0}, "standard_errors": {"g1_a1": 0.1}},
        keys[1]: result | {"parameters": {"g1_a1": 2.5, "g1_b0": None, "g1_b1": 0.0}, "standard_errors": {}},
        keys[2]: result | {"parameters": None, "standard_errors": {"a1": 0.2}},
        keys[3]: failed("died", "CRASHED"),
    }
    (tmp_path / "runs.h5").write_bytes(seal_image(manifest, [ORIGIN], results)[0])
    assert read_sealed(tmp_path / "runs.h5").results == results
    frame = load_estimates(tmp_path)
    assert frame["parameters"].tolist() == [results[key]["parameters"] for key in keys]
    assert "g1_b1" in export_rows(frame)
    # Where nothing is additive, there are none.
    image, _, _ = seal_image(plain, [ORIGIN], {key: result | {"standard_errors": {}} for key in keys})
    (tmp_path / "runs.h5").write_bytes(image)
    assert load_estimates(tmp_path)["parameters"].isna().all()
    assert {row["parameters"] for row in read_stored(tmp_path).rows()} == {None}


def test_true_values_are_those_of_the_estimated_form(tmp_path: Path) -> None:
    plain = FakePlan(Toy(), runs=1, levels=(1,)).manifest()  # type: ignore[arg-type]
    manifest = additive(plain)
    # Monic, and sums of submodels by rising natural frequency.
    fraction = {"numerator": [0, 2.0], "denominator": [0.25, 0.7, 1.0], "delay": 8.0}
    assert true_values({"content": {"system": fraction}}) == {"a1": 2.8, "a2": 4.0, "b0": 8.0, "delay": 8.0}
    truth = true_values(manifest["data_cells"][0])
    assert truth == {"g1_a1": 2.0, "g1_b0": 3.0, "g2_a1": 0.1, "g2_b0": 2.0, "delay": 0.0}
    own = {"kind": "./tank.py:Tank", "area": 2.0, "truth": {"outflow": 0.4}}
    assert true_values({"content": {"system": own}}) == {"outflow": 0.4}
    assert true_values({"content": {"data": {}}}) == {}
    manifest["success"] = {"parameter_relative_error": 0.1}
    near, far = truth, truth | {"g2_b0": 2.3}
    results = {
        slot.key: failed("", "CONVERGED") | {"parameters": found, "standard_errors": {}}
        for slot, found in zip(slots(manifest), (near, far), strict=True)
    }
    (tmp_path / "runs.h5").write_bytes(seal_image(manifest, [ORIGIN], results)[0])
    assert load_estimates(tmp_path)["converged"].tolist() == [True, False]


def test_find_an_estimate_by_the_beginning_of_its_id(place: Path) -> None:
    frame = load_estimates(place)
    wanted = frame.iloc[5]
    found = find_estimate(place.parent, wanted["id"][:8])
    assert found.folder == place
    assert found.row["id"] == wanted["id"]
    assert found.row["delay"] == wanted["delay"]
    assert found.slot.cell["content"] == {"system": PLAN.data_cells[0].content["system"], "level": 5, "seed": 7}
    assert found.slot.estimator["kind"] == "toy"
    assert found.stored.manifest["seed"] == 7
    with pytest.raises(UsageError, match="36 estimates"):
        find_estimate(place.parent, "")
    with pytest.raises(UsageError, match=r"no id in .* begins with 'xyz'"):
        find_estimate(place.parent, "xyz")


@pytest.mark.parametrize("runs", [2, 6])
def test_sealed_and_journalled_estimates_count_alike(place: Path, runs: int) -> None:
    plan = FakePlan(Toy("raise", at=1), Toy(order=3), runs=runs)
    # With fewer data sets some are set aside; a name more shares the estimates of another.
    plan.estimators = (*plan.estimators, replace(plan.estimators[0], name="again"))
    run_experiment(plan, place, jobs=1, warm=lambda plan: None)  # type: ignore[arg-type]
    sealed = experiment_status(place)
    (place / "runs.h5").unlink()
    assert experiment_status(place) == sealed
    assert (sealed.left_aside == 0) == (runs == 6)


def test_estimates_of_a_killed_run_are_readable(place: Path) -> None:
    log = open_journal(place / "journal.sqlite")
    killed: Any = FakePlan(Toy("raise", at=1), Toy(order=3), runs=8)
    log.begin(killed.manifest(), current_origins(killed), "now", {})
    log.close()
    assert len(read_stored(place).rows()) == 36
    status = experiment_status(place)
    assert (status.planned, status.done, status.todo, status.failed) == (48, 36, 12, 4)
    assert [group.todo for group in status.groups] == [4, 4, 2, 2]
    assert status.groups[1].swept == {"level": 15.5, "order": 2}


def test_folders_without_results(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no results"):
        load_estimates(tmp_path)
    assert experiment_folders(tmp_path) == []
    # As a run leaves it that is killed before it has planned anything.
    open_journal(tmp_path / "journal.sqlite").close()
    for read in (load_estimates, experiment_status):
        with pytest.raises(UsageError, match="no results"):
            read(tmp_path)
    assert experiment_folders(tmp_path / "nowhere") == []


def test_folders_with_spaces_and_umlauts(made: Path, tmp_path: Path) -> None:
    odd = Path(shutil.copytree(made, tmp_path / "Ergebnisse für #1 100%?" / "toys"))
    assert len(load_estimates(odd)) == 36
    summary = run_experiment(PLAN, odd, jobs=1, warm=lambda plan: None)  # type: ignore[arg-type]
    assert summary.computed == 0


def test_a_read_only_folder_can_be_read(place: Path) -> None:
    place.chmod(0o555)
    try:
        assert len(load_estimates(place)) == 36
        assert experiment_status(place).done == 36
    finally:
        place.chmod(0o755)


#: Seals in processes that may write files of some sizes only, and in ones that may write nothing of one column.
SEALING = """
import os, resource, signal, sys
from pathlib import Path
from ctid_cli.storage import sealed
from ctid_cli.storage.packing import Packed, PackedTable
from ctid_cli.storage.manifest import slots
from tests.storage.sealed_images import read_sealed

runs = read_sealed(Path(sys.argv[1]))
table = PackedTable(runs.manifest, [Packed(slot, runs.results[slot.key]) for slot in slots(runs.manifest)])
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
write_column, columns = sealed._write_column, []

def allow(size):
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))

def writing(group, column, table, number):
    columns.append(column)
    if len(columns) == number:
        allow(0)
    write_column(group, column, table)
    if len(columns) == number:
        allow(resource.RLIM_INFINITY)

for number in range(13):
    if not os.fork():
        if sys.argv[3] == "room":
            allow(1000 + 3000 * number)
        else:
            sealed._write_column = lambda *given: writing(*given, 1 + 3 * number)
        try:
            sealed.write_sealed(runs.manifest, runs.origins, table, Path(sys.argv[2]))
            print("written" if 1 + 3 * number <= len(columns) else "no such column", flush=True)
        except OSError as error:
            print(error.strerror, flush=True)
        sys.exit()
    os.wait()
"""


@pytest.mark.parametrize("what", ["room", "column"])
def test_what_hdf5_cannot_write_is_an_error_and_nothing_else(what, tmp_path):
    stored = Path(__file__).parent / "stored" / "system" / "runs.h5"
    command = [sys.executable, "-c", SEALING, str(stored), str(tmp_path / "runs.h5"), what]
    done = subprocess.run(command, cwd=Path(__file__).parents[2], capture_output=True, text=True)
    assert done.stderr == ""
    said = done.stdout.splitlines()
    assert set(said) - {"no such column"} == {"File too large"}
    assert said.count("File too large") > 5


def test_times_that_are_there_and_cannot_be_read_are_not_missing(tmp_path):
    place = tmp_path / "system"
    shutil.copytree(Path(__file__).parent / "stored" / "system", place)
    (place / "journal.sqlite").unlink(missing_ok=True)
    (place / "timings.csv").unlink(missing_ok=True)
    assert load_estimates(place)["seconds"].isna().all()
    (place / "timings.csv").mkdir()
    with pytest.raises(StorageError, match=r"timings.csv cannot be read \(Is a directory\)"):
        load_estimates(place)
