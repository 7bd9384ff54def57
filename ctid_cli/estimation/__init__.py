"""Common parts of the estimators: problems, iterations, searches over the delay, starts."""
