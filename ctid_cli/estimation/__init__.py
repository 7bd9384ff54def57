"""What the estimators share: problems, iterations, searches over the delay, starts."""
