"""Tables of frequency responses: all forms of a table give the same data; refusals."""

import numpy as np
import pytest

from ctid_cli import DataError, FrequencyData, read_frequency_data
from ctid_cli.signals.frequency_data import is_frequency_table

W = np.array([0.5, 1.0, 2.0])
VALUES = 2.0 / (1j * W + 1.0)


def table(folder, header, *columns, comment=""):
    rows = "\n".join(",".join(f"{value:.17g}" for value in row) for row in zip(*columns, strict=True))
    file = folder / "response.csv"
    file.write_text(f"{comment}{header}\n{rows}\n", encoding="utf-8")
    return file


@pytest.mark.parametrize(
    ("header", "columns"),
    [
        ("frequency [rad/s],real,imaginary", (W, VALUES.real, VALUES.imag)),
        ("Freq (Hz),Re,Im", (W / (2 * np.pi), VALUES.real, VALUES.imag)),
        ("f [kHz],gain,phase [deg]", (W / (2e3 * np.pi), np.abs(VALUES), np.rad2deg(np.angle(VALUES)))),
        ("w [rad/s],magnitude [dB],phase [rad]", (W, 20 * np.log10(np.abs(VALUES)), np.angle(VALUES))),
        ("omega [rad/s],mag_db,phase_deg", (W, 20 * np.log10(np.abs(VALUES)), np.rad2deg(np.angle(VALUES)))),
    ],
)
def test_every_form_is_the_same_response(tmp_path, header, columns):
    file = table(tmp_path, header, *columns)
    assert is_frequency_table(file)
    data = read_frequency_data(file)
    np.testing.assert_allclose(data.frequencies, W, rtol=1e-12)
    np.testing.assert_allclose(data.response, VALUES, rtol=1e-12)
    assert data.standard_error is None


def test_units_errors_samples_and_lines_without_a_value(tmp_path):
    values = VALUES.copy()
    values[1] = np.nan
    header = "frequency [rad/ms],real [mm/V],imaginary [mm/V],standard_error [mm/V]"
    comment = "# hold: zoh\n# interval: 0.05 ms\n"
    file = table(tmp_path, header, W, values.real, values.imag, np.full(3, 0.1), comment=comment)
    data = read_frequency_data(file)
    assert (data.units, data.interval, data.frequencies.tolist()) == (("ms", "mm", "V"), 0.05, [0.5, 2.0])
    assert "1 of 3 lines have no value" in " ".join(data.notes)
    assert read_frequency_data(file, low=1.0).frequencies.tolist() == [2.0]


@pytest.mark.parametrize(
    ("header", "comment", "message"),
    [
        ("frequency,real,imaginary", "", "frequency' must have a unit"),
        ("frequency [rad/s],gain,phase", "", "phase' must have a unit"),
        ("frequency [rad/s],real,b", "", "no column 'gain'"),
        ("frequency [rad/s],real,imaginary", "# hold: foh\n", "1: hold must be zoh or none, not 'foh'"),
        ("frequency [rad/s],real,imaginary", "# hold: zoh\n", "1: hold zoh needs the sampling interval"),
        ("frequency [rad/s],real,imaginary", "# interval: 1\n", "1: an interval needs the hold"),
        (
            "frequency [rad/s],real,imaginary",
            "# hold: zoh\n# interval: fast\n",
            "2: interval must be a positive number",
        ),
        ("frequency [rad/s],real,imaginary", "# hold: zoh\n# interval: 3\n", "beyond half the sampling frequency"),
    ],
)
def test_what_is_refused_of_a_table(tmp_path, header, comment, message):
    with pytest.raises(DataError, match=message):
        read_frequency_data(table(tmp_path, header, W, VALUES.real, VALUES.imag, comment=comment))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ((W, VALUES[:2]), "one length"),
        ((-W, VALUES), "none below"),
        ((W, np.zeros(3)), "not all zero"),
        ((W, VALUES, np.array([1.0, 0.0, 1.0])), "standard_error at 1 rad/s is 0"),
        ((W, VALUES, None, -1.0), "interval must be a positive number"),
    ],
)
def test_what_is_refused_of_arrays(values, message):
    with pytest.raises(DataError, match=message):
        FrequencyData(*values)
