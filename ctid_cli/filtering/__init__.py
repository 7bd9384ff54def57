"""Exact filtering and simulation on any clock, with any delay; sets of low-pass filters and their effect on a cost."""
