"""Estimators: one algorithm per file, their options are their fields."""
