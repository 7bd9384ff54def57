"""Fit of a model to records: what is not given is chosen by one criterion and by held-back blocks."""
