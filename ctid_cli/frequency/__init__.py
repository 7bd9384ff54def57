"""Finite-time frequency estimation of multi-sinusoidal signals, for whole records or sample by sample.

An estimator is a frozen dataclass of options. ``options.track(samples, interval)`` returns the frequencies at every
sample of a record; ``online = options.start(interval)`` and ``online.update(sample)`` process single samples, with
equal results up to rounding. Every row has flags for reasons why it is unreliable, and a sentence for each flag.

The recommended tracker is :class:`RestartingLeastSquares` with a prefilter. :class:`DremGradient`,
:class:`DremFiniteTime` and :class:`DremWindow` mix the same regression into scalar ones.
"""
