"""MATLAB files: plain arrays of every version, and objects that only MATLAB can read."""

import struct

import h5py
import numpy as np
import pytest
import scipy.io
from scipy.io.matlab import MatlabObject

from ctid_cli.errors import DataError
from ctid_cli.signals.measurement import read_measurement

T = 0.1 * np.arange(5)
U = np.array([1.0, -1.0, 1.0, 1.0, -1.0])
Y = np.array([0.0, 0.5, np.nan, 0.25, 0.125])


@pytest.fixture
def rig(tmp_path):
    return tmp_path / "rig.mat"


def opaque(variable, kind):
    """Return a version 5 file with one object, in MATLAB's layout."""

    def element(code, data):
        return struct.pack("<II", code, len(data)) + data + b"\0" * (-len(data) % 8)

    flags = element(6, struct.pack("<II", 17, 0))
    names = b"".join(element(1, text) for text in (variable, b"MCOS", kind))
    inner = element(14, element(6, struct.pack("<II", 13, 0)) + element(5, struct.pack("<ii", 1, 1)) + element(1, b"")
                    + element(6, struct.pack("<I", 0xDD000000)))  # fmt: skip
    head = b"MATLAB 5.0 MAT-file".ljust(116) + b"\0" * 8 + struct.pack("<HH", 0x0100, 0x4D49)
    return head + element(14, flags + names + inner)


def save_v73(path, groups):
    """Write a version 7.3 file: HDF5 after a MATLAB header; arrays are transposed."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, (kind, value) in groups.items():
            item = file.create_group(name) if value is None else file.create_dataset(name, data=value)
            item.attrs["MATLAB_class"] = np.bytes_(kind)
    with open(path, "r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file".ljust(116) + b"\0" * 8 + struct.pack("<HH", 0x0200, 0x4D49))


# --- accepted files -------------------------------------------------------------------------------

COLUMNS = {"t": T, "u": U, "y": Y}
V73 = {name: (b"double", value[None, :]) for name, value in COLUMNS.items()}
BESIDE = {"#refs#": (b"cell", None), "note": (b"char", np.array([[104], [105]], np.uint16))}
SAVE = {
    "version 4, rows": lambda path: scipy.io.savemat(path, COLUMNS, format="4", oned_as="row"),
    "version 4, columns": lambda path: scipy.io.savemat(path, COLUMNS, format="4", oned_as="column"),
    "version 5, rows": lambda path: scipy.io.savemat(path, COLUMNS, format="5", oned_as="row"),
    "version 5, columns": lambda path: scipy.io.savemat(path, COLUMNS, format="5", oned_as="column"),
    "version 7.3": lambda path: save_v73(path, {**V73, **BESIDE}),
    "struct": lambda path: scipy.io.savemat(path, {"z": {**COLUMNS, "name": "rig"}, "x": 3.0}),
    "struct, 7.3": lambda path: save_v73(path, {"z": (b"struct", None)} | {f"z/{k}": v for k, v in V73.items()}),
    "interval": lambda path: scipy.io.savemat(path, {"Ts": 0.1, "u": U, "y": Y}),
    "object beside": lambda path: save_beside_object(path, COLUMNS),
}


def save_beside_object(path, arrays):
    scipy.io.savemat(path, arrays)
    path.write_bytes(path.read_bytes() + opaque(b"z", b"iddata")[128:])


@pytest.mark.parametrize("kind", SAVE)
def test_one_record_in_many_ways(rig, kind):
    SAVE[kind](rig)
    found = read_measurement(rig)
    assert np.array_equal(found.record.t, T)
    assert np.array_equal(found.record.input.values, U)
    assert np.array_equal(found.record.y, Y, equal_nan=True)
    if kind.startswith("struct"):
        assert (found.time, found.input, found.output) == ("z.t", "z.u", "z.y")
    interval = "'Ts' is one number: it was taken as the sampling interval, 0.1 s, from 0 s on."
    assert found.notes == ((interval,) if kind == "interval" else ())


def test_of_two_structs_one_must_be_chosen(rig):
    scipy.io.savemat(rig, {"est": {"t": T, "u": U, "y": Y}, "val": {"t": T, "u": -U, "y": Y}})
    with pytest.raises(DataError, match=r"'est\.t' and 'val\.t' may all be the time; say which one"):
        read_measurement(rig)
    chosen = read_measurement(rig, output="val.y", time="val.t")
    assert np.array_equal(chosen.record.input.values, -U)


# --- refused files --------------------------------------------------------------------------------

LINE = (
    "s = struct('t', z.SamplingInstants, 'u', z.InputData, 'y', z.OutputData); "
    "save('rig_plain.mat', '-struct', 's', '-v7')"
)


def save_object(path, version):
    if version == "old object":
        fields = np.zeros((1, 1), dtype=[("InputData", object), ("OutputData", object)])
        fields[0, 0] = (U, Y)
        scipy.io.savemat(path, {"z": MatlabObject(fields, "iddata")})
    elif version == "opaque":
        path.write_bytes(opaque(b"z", b"iddata"))
    else:
        save_v73(path, {"z": (b"iddata", np.array([[3707764736, 2, 1, 1, 1, 1]], np.uint32))})
        with h5py.File(path, "r+") as file:
            file["z"].attrs["MATLAB_object_decode"] = np.int32(3)


@pytest.mark.parametrize("version", ["old object", "opaque", "7.3"])
def test_iddata_is_answered_with_the_line_that_exports_it(rig, version):
    save_object(rig, version)
    with pytest.raises(DataError) as error:
        read_measurement(rig)
    assert str(error.value).startswith(f"{rig}: 'z' is a MATLAB iddata object, which only MATLAB can read")
    assert str(error.value).splitlines()[1].strip() == LINE


def test_the_line_is_given_where_the_arrays_beside_an_object_do_not_suffice(rig):
    save_beside_object(rig, {"t": T})
    with pytest.raises(DataError, match="a record needs a time, an input and an output") as error:
        read_measurement(rig)
    assert LINE in str(error.value)


@pytest.mark.parametrize(
    ("content", "options", "message"),
    [
        ({"t": T, "u": np.ones((5, 2)), "y": Y}, {}, "variable 'u' is a 5x2 array; save the columns you mean"),
        ({"t": T, "u": "held", "y": Y}, {}, "variable 'u' does not hold numbers"),
        ({"t": T, "u": np.array([U, Y], dtype=object), "y": Y}, {}, "variable 'u' does not hold numbers"),
        ({"t": T, "u": U * 1j, "y": Y}, {}, "variable 'u' holds complex numbers"),
        ({"t": T, "u": np.empty((0, 0)), "y": Y}, {}, "variable 'u' is empty"),
        ({"t": T, "u": U[:4], "y": Y}, {}, "'u' has 4 values and 'y' has 5; they must be equally many"),
        ({"t": T[:4], "u": U, "y": Y}, {}, "'t' has 4 values and 'y' has 5"),
        ({"t": T[::-1], "u": U, "y": Y}, {}, "sample 2: time 't' goes back to 0.3 s after 0.4 s on sample 1"),
        ({"t": T, "valve": U, "y": Y}, {}, "no variable is called 'u' or 'input'; the file has 't', 'valve', 'y'"),
        ({"Ts": -0.1, "u": U, "y": Y}, {}, "'Ts' is -0.1; a sampling interval must be a positive number"),
        ({}, {}, "the file holds no arrays; in MATLAB, save plain vectors"),
    ],
)
def test_one_sentence(rig, content, options, message):
    scipy.io.savemat(rig, content)
    with pytest.raises(DataError) as error:
        read_measurement(rig, **options)
    assert str(error.value).startswith(f"{rig}:")
    assert message in str(error.value)


@pytest.mark.parametrize("content", [b"", b"t,u,y\n0,1,2\n", b"\x89PNG\r\n" * 40, b"MATLAB 5.0 MAT-file".ljust(124)])
def test_what_is_no_matlab_file(rig, content):
    rig.write_bytes(content)
    with pytest.raises(DataError, match=r"rig\.mat: (this is not a MATLAB file|the file is empty|the file holds no)"):
        read_measurement(rig)


def test_a_cut_file_is_refused_or_incomplete_but_never_a_traceback(rig):
    scipy.io.savemat(rig, {"t": T, "u": U, "y": Y})
    whole = rig.read_bytes()
    for length in range(100, len(whole) - 1, 16):
        rig.write_bytes(whole[:length])
        with pytest.raises(DataError, match=r"rig\.mat"):
            read_measurement(rig)
