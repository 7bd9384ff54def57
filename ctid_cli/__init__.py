"""Identification of continuous-time models, frequencies of signals, and Monte Carlo studies of both."""

import lazy_loader

__version__ = "0.1.0"

# The public names, by topic, are in __init__.pyi. Each is imported when it is first used: `ctid --help` must not
# wait for numpy and numba.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
