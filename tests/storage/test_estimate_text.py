"""Estimates in the format for other programs."""

from ctid_cli.storage.estimates import ESTIMATE_KEYS, as_object


def test_the_documented_keys_come_first_and_parameters_before_their_errors():
    keys = list(as_object({"snr_db": 5, "delay": 8.0, "id": "x"}))
    assert (tuple(keys[:-1]), keys[-1]) == (ESTIMATE_KEYS, "snr_db")
    keys = list(as_object({"parameters": {}, "id": "x", "standard_errors": {}}))
    assert keys[keys.index("standard_errors") - 1] == "parameters"
