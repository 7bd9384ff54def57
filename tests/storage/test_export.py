from __future__ import annotations

import hashlib
import json
import re
import resource
import signal
import subprocess
import sys
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from ctid_cli.errors import RefusedError, StorageError
from ctid_cli.storage.columns import failed, no_result
from ctid_cli.storage.estimates import Estimates
from ctid_cli.storage.export import open_export, sha256_of, write_runs
from ctid_cli.storage.journal import open_journal
from ctid_cli.storage.manifest import slots
from tests.storage.made_results import ORIGIN, export_image, outcomes_of, plan_of

MANIFEST = plan_of(5).manifest()
RESULTS = {one.key: one.result for one in outcomes_of(MANIFEST)}


@pytest.fixture
def path(place: Path) -> Path:
    return place / "runs.h5"


def read(path: Path) -> dict[Any, Any]:
    export = open_export(path)
    export.verify()
    return Estimates(export).results


def test_it_holds_what_was_computed_and_explains_itself(path: Path) -> None:
    assert read(path) == RESULTS
    with h5py.File(path) as file:
        assert (file.attrs["experiment"], file.attrs["seed"], file.attrs["runs"]) == ("toys", 1, 5)
        assert file.attrs["code_version"] == ORIGIN.code_version
        assert json.loads(file["manifest"].asstr()[()]) == MANIFEST
        group = file["estimates"]
        assert group["status"].asstr()[()].tolist().count("FAILED") == 6
        assert group["delay"].attrs["unit"] == "s"
        assert set(np.unique(group["swept/snr_db"][()])) == {10.0, 20.0}
        assert group["standard_error_names"].asstr()[()].tolist() == ["b0", "delay"]
        assert group["status"].attrs["meaning"] == "how the estimate ended"
        names: list[str] = []
        file.visit(names.append)
        assert not [name for name in names if any(word in name for word in ("second", "time", "host", "session"))]
        texts = [file[name] for name in names if getattr(file[name], "dtype", np.dtype("f8")).kind in "SO"]
        assert all(h5py.check_string_dtype(text.dtype).encoding == "utf-8" for text in texts)


def test_the_documented_lines_read_it_with_h5py_and_pandas_alone(path: Path) -> None:
    page = (Path(__file__).parents[2] / "docs" / "machine-readable.md").read_text(encoding="utf-8")
    (lines,) = re.findall(r"^    import json\n(?:    .*\n|\n)+", page, re.MULTILINE)
    code = textwrap.dedent(lines).replace("results/quickstart/runs.h5", "runs.h5")
    told = "import sys; print(experiment, spec['monte_carlo']['seed'], units['delay'], len(estimates))\n"
    told += "print(*sorted(estimates['status'].unique()), [name for name in sys.modules if name.startswith('ctid')])"
    run = [sys.executable, "-c", code + told]
    done = subprocess.run(run, stdout=subprocess.PIPE, text=True, cwd=path.parent, check=True)
    assert done.stdout.splitlines() == [f"toys 1 s {len(RESULTS)}", "CONVERGED FAILED []"]


def test_extreme_contents_come_back(tmp_path: Path) -> None:
    keys = [slot.key for slot in slots(MANIFEST)]
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
    }
    parts = odd | {"parameters": {"g1_a1": 2.5, "g1_b0": None}, "standard_errors": {"g1_a1": 0.1}}
    for results in ({keys[0]: odd, keys[1]: failed("died", "CRASHED")}, {keys[0]: odd, keys[2]: parts}, {}):
        (tmp_path / "runs.h5").write_bytes(export_image(MANIFEST, [ORIGIN], results))
        assert read(tmp_path / "runs.h5") == results


def test_every_flipped_bit_of_data_is_found_without_a_journal(path: Path) -> None:
    intact, rng, found = path.read_bytes(), np.random.default_rng(5), 0
    positions = rng.integers(0, len(intact), 120).tolist()
    for position in positions:
        damaged = bytearray(intact)
        damaged[position] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        try:
            assert read(path) == RESULTS, "what HDF5 does not use"
        except (StorageError, RefusedError):
            found += 1
    assert found > 40
    path.write_bytes(intact[: len(intact) // 2])
    with pytest.raises(StorageError, match=r"cannot be read"):
        read(path)


def _plan(change: Callable[[dict[str, Any]], Any]) -> Callable[[h5py.File], None]:
    def within(file: h5py.File) -> None:
        plan = json.loads(bytes(file["manifest"][()]))
        change(plan)
        del file["manifest"]
        file["manifest"] = np.array(json.dumps(plan).encode())
        file["manifest"].attrs["sha256"] = hashlib.sha256(json.dumps(plan).encode()).hexdigest()

    return within


def _column(name: str, values: Any) -> Callable[[h5py.File], None]:
    def within(file: h5py.File) -> None:
        del file["estimates"][name]
        file["estimates"][name] = values

    return within


def _huge(file: h5py.File) -> None:
    del file["estimates"]["delay"]
    file["estimates"].create_dataset("delay", shape=(10**12,), dtype="f8", chunks=(1000,))


CHANGES: dict[str, Callable[[h5py.File], Any]] = {
    "a shorter column": _column("delay", np.zeros(1)),
    "text for numbers": _column("delay", np.array([b"text"] * 30)),
    "numbers for text": _column("status", np.zeros(30)),
    "lengths beyond the column": _column("denominator_length", np.full(30, 9)),
    "a link to another file": _column("delay", h5py.ExternalLink("/etc/passwd", "/x")),
    "a link within": _column("delay", h5py.SoftLink("/estimates/cost")),
    "8 TB": _huge,
    "no plan": _plan(dict.clear),
    "1e9 data sets": _plan(lambda plan: plan["data_cells"][0].update(replicates=10**9)),
    "a name outside": _plan(lambda plan: plan.update(experiment="../../etc/passwd")),
    "no data cells": _plan(lambda plan: plan.update(data_cells=[])),
    "a start that is not described": _plan(lambda plan: plan["starts"].clear()),
    "a rule of words": _plan(lambda plan: plan.update(success={"band": "wide"})),
}


@pytest.mark.parametrize("case", CHANGES)
def test_content_that_no_run_has_written_is_refused(case: str, path: Path) -> None:
    with h5py.File(path, "r+") as file:
        CHANGES[case](file)
    with pytest.raises(StorageError, match=r"cannot be read"):
        open_export(path)


def test_another_format_is_refused(path: Path) -> None:
    with h5py.File(path, "r+") as file:
        file.attrs["format_version"] = 3
    with pytest.raises(RefusedError, match="format 3; this ctid reads format 2"):
        open_export(path)


def test_it_is_written_once_and_again_when_it_is_not_what_was_written(path: Path) -> None:
    log, intact, before = open_journal(path.with_name("journal.sqlite")), path.read_bytes(), path.stat().st_mtime_ns
    assert intact == export_image(MANIFEST, [ORIGIN], RESULTS)
    assert write_runs(path.parent, log) == (30, sha256_of(path))
    assert (log.exported(), path.stat().st_mtime_ns) == (sha256_of(path), before)
    for damage in (intact[:-9], b""):
        path.write_bytes(damage)
        assert write_runs(path.parent, log) == (30, log.exported())
        assert path.read_bytes() == intact
    log.close()


def test_a_full_disk_gives_one_sentence_and_leaves_no_file(path: Path) -> None:
    log, most = open_journal(path.with_name("journal.sqlite")), resource.getrlimit(resource.RLIMIT_FSIZE)
    path.unlink()
    before = {file.name for file in path.parent.iterdir()}
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4000, most[1]))
    try:
        with pytest.raises(
            StorageError, match=rf"^{path} could not be written \(File too large\); all 30 .* are safe in "
        ):
            write_runs(path.parent, log)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, most)
        signal.signal(signal.SIGXFSZ, ignored)
    assert {file.name for file in path.parent.iterdir()} == before
    log.close()
