"""Data sets of an experiment, and what is measured of their estimates."""
