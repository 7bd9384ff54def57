"""Models: what an estimator returns and a simulation takes."""
