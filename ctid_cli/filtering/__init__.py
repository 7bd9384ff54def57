"""Exact filtering and simulation on any clock, with any delay; sets of low-pass filters and what they do to a cost."""

from ctid_cli.filtering.bank import FilterData, filter_data, second_moments, standard_rows
from ctid_cli.filtering.filter_set import FilterSet, check_filters, sufficient_number_of_filters
from ctid_cli.filtering.filter_theory import convergence_region, extrema, filtered_cost, ideal_cost
from ctid_cli.filtering.loop import simulate_loop
from ctid_cli.filtering.lowpass import Lowpass
from ctid_cli.filtering.sampled import simulate_additive
from ctid_cli.filtering.simulate import simulate

__all__ = [
    "FilterData",
    "FilterSet",
    "Lowpass",
    "check_filters",
    "convergence_region",
    "extrema",
    "filter_data",
    "filtered_cost",
    "ideal_cost",
    "second_moments",
    "simulate",
    "simulate_additive",
    "simulate_loop",
    "standard_rows",
    "sufficient_number_of_filters",
]
