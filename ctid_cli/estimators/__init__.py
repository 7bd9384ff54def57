"""Estimators: one algorithm per file, with the options as fields."""
