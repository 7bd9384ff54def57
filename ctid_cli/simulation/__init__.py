"""Data sets of an experiment, and measures of their estimates."""
