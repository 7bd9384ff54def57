"""Frequencies of multi-sinusoidal signals: online estimators and batch references.

An online estimator is a frozen dataclass of options. ``tracker = options.start(interval)`` takes samples one by one,
``tracker.update(sample)``, or many at once, ``tracker.run(samples)``, with the same numbers bit for bit;
``tracker.state()`` and ``options.restore(interval, state)`` stop and go on in the middle of a signal. A batch estimator
(``online`` is False) has ``options.estimate(samples, interval)``. Every estimate carries flags that say why it must not
be trusted, if so, and a sentence for each.

The recommended tracker is :class:`RestartingLeastSquares` with a prefilter. :class:`DremGradient`,
:class:`DremFiniteTime` and :class:`DremWindow` mix the same regression into scalar ones. :func:`fit_sinusoids` finds
amplitudes, phases and the bias once the frequencies are known.
"""
