"""Exact filtering and simulation on any clock, with any delay."""

from ctid_cli.filtering.bank import FilterData, filter_data, second_moments, standard_rows
from ctid_cli.filtering.lowpass import Lowpass
from ctid_cli.filtering.simulate import simulate

__all__ = ["FilterData", "Lowpass", "filter_data", "second_moments", "simulate", "standard_rows"]
