"""Accuracy and quality of an estimate, whichever algorithm found it."""
