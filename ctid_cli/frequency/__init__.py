"""Frequencies of multi-sinusoidal signals in finite time, of whole records or sample by sample.

An estimator is a frozen dataclass of options. ``options.track(samples, interval)`` gives the frequencies at every
sample of a record; ``online = options.start(interval)`` takes one sample after the other, ``online.update(sample)``,
with the same numbers up to rounding. Every row carries flags that say why it must not be trusted, if so, and a sentence
for each.

The recommended tracker is :class:`RestartingLeastSquares` with a prefilter. :class:`DremGradient`,
:class:`DremFiniteTime` and :class:`DremWindow` mix the same regression into scalar ones.
"""
