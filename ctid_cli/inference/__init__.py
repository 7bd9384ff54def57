"""Accuracy and quality of estimates, independent of the estimation method."""
