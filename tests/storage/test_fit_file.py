"""Reading of ``fit.json``: an identical fit to the last bit, or a one-sentence error."""

import dataclasses
import json
import pickle
import shutil

import numpy as np
import pytest

from ctid_cli import (
    DataError,
    DelayProfile,
    HeldSignal,
    Record,
    TransferFunction,
    identify,
    load_fit,
    save_fit,
    simulate,
)
from ctid_cli.canonical import content_hash
from ctid_cli.errors import UsageError
from ctid_cli.reporting.fit_result import FitResult
from ctid_cli.reporting.records import Records
from ctid_cli.signals.measurement import read_measurement
from ctid_cli.storage.fit_file import read_fit

SYSTEM = TransferFunction([3.0], [1.0, 1.2, 4.0], 0.73)


def record_of(seed=0, n=300, noise=0.05):
    rng = np.random.default_rng(seed)
    t = 0.1 * np.arange(n)
    u = HeldSignal(t, np.repeat(rng.choice([-1.0, 1.0], n // 5), 5))
    y = simulate(SYSTEM, u, t) + noise * rng.standard_normal(n)
    y[seed + 7] = np.nan
    return Record(t, y, u, name=f"record {seed}")


def require_same(one, other):
    """Assert equal types and bits in all parts."""
    assert type(one) is type(other) or isinstance(one, float | int | bool)
    if dataclasses.is_dataclass(one):
        for field in dataclasses.fields(one):
            require_same(getattr(one, field.name), getattr(other, field.name))
    elif isinstance(one, np.ndarray):
        assert one.dtype == other.dtype
        assert one.shape == other.shape
        assert one.tobytes() == other.tobytes()
    elif isinstance(one, dict):
        assert list(one) == list(other)
        for name in one:
            require_same(one[name], other[name])
    elif isinstance(one, tuple | list):
        assert len(one) == len(other)
        for a, b in zip(one, other, strict=True):
            require_same(a, b)
    else:
        assert one == other or (one != one and other != other)


CASES = {
    "two records with states and offsets": (
        DelayProfile(2, 1, (0, 3), initial_state="estimate", offset="estimate"),
        2,
        (),
    ),
    "means removed, known delay": (DelayProfile(2, 1, (0.7, 0.7), offset="remove"), 1, ("robust",)),
    "tukey, bootstrap": (DelayProfile(2, 0, (0, 3), loss="tukey"), 1, ("bootstrap", 50)),
    "delay at its bound": (DelayProfile(2, 0, (0, 0.5)), 1, ()),
}


@pytest.mark.parametrize("case", CASES)
def test_a_fit_is_read_back_to_the_last_bit(case, tmp_path):
    options, n, noise = CASES[case]
    result = identify([record_of(k) for k in range(n)], options, record_of(5), *noise)
    save_fit(result, tmp_path / "fit.json")
    again = load_fit(tmp_path / "fit.json")
    require_same(result, again)
    for kind in ("covariance", "degrees_of_freedom"):
        require_same(getattr(result.uncertainty, kind), getattr(again.uncertainty, kind))
    require_same(pickle.loads(pickle.dumps(load_fit(tmp_path / "fit.json"))), result)


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """Return a fit, and the folder with its ``fit.json`` next to the folder of its record."""
    record, folder = record_of(), tmp_path_factory.mktemp("fitted")
    rows = np.column_stack((record.t, record.input.values, record.y)).tolist()
    lines = ["t [s],u [V],y [mm]", *(f"{t!r},{u!r},{'' if np.isnan(y) else repr(y)}" for t, u, y in rows)]
    (folder / "data").mkdir()
    (folder / "data" / "record.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    measured = [read_measurement(folder / "data" / "record.csv", stop=25.0)]
    result = identify(measured[0].record, DelayProfile(2, 0, (0.7, 0.7)))
    (folder / "fit.json").write_text(FitResult(result, Records(measured)).file_text(folder), encoding="utf-8")
    return result, folder


@pytest.fixture
def stored(fitted, tmp_path):
    """Return the fit, and its file in a copy of the folder."""
    result, folder = fitted
    return result, shutil.copytree(folder, tmp_path / "stored") / "fit.json"


def test_a_record_is_named_and_read_when_it_is_wanted(stored):
    result, path = stored
    content = json.loads(path.read_text(encoding="utf-8"))
    source = content["records"][0]
    assert source["path"] == "data/record.csv"
    assert source["columns"] == {"time": "t [s]", "input": "u [V]", "output": "y [mm]"}
    assert (source["from"], source["to"], source["hold"]) == (None, 25.0, "zoh")
    again = load_fit(path)
    require_same(result, again)
    shutil.move(path.parent / "data" / "record.csv", path.parent / "moved.csv")
    left = load_fit(path)
    require_same(left.fit.covariance, result.fit.covariance)
    with pytest.raises(DataError, match=r"record .*data.record.csv does not exist; say where it is now: --record FILE"):
        left.records  # noqa: B018
    require_same(load_fit(path, record=path.parent / "moved.csv"), result)


def test_another_record_is_refused(stored):
    _, path = stored
    file = path.parent / "data" / "record.csv"
    file.write_text(file.read_text(encoding="utf-8").replace("\n0.1,", "\n0.11,"), encoding="utf-8")
    with pytest.raises(DataError, match="is not the file that the fit is of"):
        load_fit(path).fit.residuals  # noqa: B018
    with pytest.raises(DataError, match="is not the file that the fit is of"):
        load_fit(path, record=file)
    with pytest.raises(UsageError, match=r"is of 1 records; --record names 2"):
        load_fit(path, record=[file, file])
    with pytest.raises(UsageError, match="has no validation record"):
        load_fit(path, validation=file)


def changed(path, change, sealed=True):
    content = json.loads(path.read_text(encoding="utf-8"))
    change(content)
    if sealed:
        del content["checksum"]
        content["checksum"] = content_hash(content)
    path.write_text(json.dumps(content), encoding="utf-8")
    return path


BAD = {
    "newer": (lambda c: c.update(format=3), True, r"newer ctid \(.*\): its format is 3, and this one reads up to 2"),
    "an older format": (lambda c: c.update(format=1), True, "was written by an older ctid and cannot be read back"),
    "other kind": (lambda c: c.update(kind="ctid track"), True, "is no fit but of kind 'ctid track'"),
    "other result": (lambda c: [c.pop(key) for key in ("kind", "residual_tests")], True, "another kind of result"),
    "older": (lambda c: c.pop("kind"), True, "a fit of an older ctid"),
    "by hand": (lambda c: c["result"]["fit"].update(cost=1.0), False, "was changed after it was written"),
    "no number": (lambda c: c["result"]["fit"].update(cost="much"), True, "damaged .*result.fit.cost"),
    "NaN": (lambda c: c["result"]["fit"].update(cost=float("nan")), False, "NaN is no JSON number"),
    "a NaN model": (lambda c: c["result"]["fit"]["model"].update(delay="nan"), True, "damaged .*delay"),
    "another class": (lambda c: c["result"]["fit"].update(type="Popen"), True, r"damaged \(result.fit is not"),
    "shape": (lambda c: c["result"]["fit"]["covariance"].update(shape=[2, 3]), True, "damaged"),
    "units": (lambda c: c.update(units={"time": 1}), True, r"damaged \(its units"),
    "command": (lambda c: c.update(command=["rm"]), True, r"damaged \(its command"),
    "columns": (lambda c: c["records"][0]["columns"].update(time=None), True, r"damaged \(its columns"),
    "hold": (lambda c: c["records"][0].update(hold="no"), True, r"damaged \(its hold"),
    "path": (lambda c: c["records"][0].update(path=7), True, r"damaged \(its path"),
    "window": (lambda c: c["records"][0].update({"from": "now"}), True, r"damaged \(its from and to"),
    "missing": (lambda c: c.pop("records"), True, "damaged"),
}


@pytest.mark.parametrize("case", BAD)
def test_what_is_no_fit_is_refused_in_a_sentence(case, stored):
    change, sealed, sentence = BAD[case]
    with pytest.raises(DataError, match=sentence) as caught:
        load_fit(changed(stored[1], change, sealed))
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 500


@pytest.mark.parametrize("text", ["", "{", "[1, 2]", "[" * 100_000, '{"kind": "ctid fit"}', "\x00\xff"])
def test_rubbish_is_refused(text, tmp_path):
    (tmp_path / "fit.json").write_text(text, encoding="latin-1")
    with pytest.raises(DataError, match=r"fit\.json"):
        load_fit(tmp_path / "fit.json")


def test_too_large_a_file_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("ctid_cli.storage.result_file.MAX_BYTES", 10)
    (tmp_path / "fit.json").write_text("{}" + " " * 20, encoding="utf-8")
    with pytest.raises(DataError, match="22 bytes are too many for a fit; at most 10 are read"):
        read_fit(tmp_path / "fit.json")
