"""What to cite for a fit or a track, as BibTeX: ctid, and the methods of others that it used."""

import ctid_cli
from ctid_cli.estimators.identification import Identification

_CTID = """\
@software{{ctid,
  author  = {{{{the ctid developers}}}},
  title   = {{ctid: identification of continuous-time models with a time delay}},
  version = {{{version}}},
}}"""

_PROJECTION = """\
@article{kaufman1975,
  author  = {Kaufman, L.},
  title   = {A variable projection method for solving separable nonlinear least squares problems},
  journal = {BIT},
  volume  = {15},
  pages   = {49--57},
  year    = {1975},
  doi     = {10.1007/BF01932995},
}"""

_ADDITIVE = """\
@article{gonzalez2025,
  author  = {Gonz{\\'a}lez, R. A. and Classens, K. and Rojas, C. R. and Welsh, J. S. and Oomen, T.},
  title   = {Identification of additive continuous-time systems in open and closed loop},
  journal = {Automatica},
  year    = {2025},
  note    = {arXiv:2401.01263},
}"""

_ROBUST = """\
@book{huber2009,
  author    = {Huber, P. J. and Ronchetti, E. M.},
  title     = {Robust Statistics},
  edition   = {2},
  publisher = {Wiley},
  year      = {2009},
  doi       = {10.1002/9780470434697},
}"""

_LIKELIHOOD = """\
@article{patterson1971,
  author  = {Patterson, H. D. and Thompson, R.},
  title   = {Recovery of inter-block information when block sizes are unequal},
  journal = {Biometrika},
  volume  = {58},
  pages   = {545--554},
  year    = {1971},
  doi     = {10.1093/biomet/58.3.545},
}"""

_FREQUENCY = """\
@book{pintelon2012,
  author    = {Pintelon, R. and Schoukens, J.},
  title     = {System Identification: A Frequency Domain Approach},
  edition   = {2},
  publisher = {Wiley},
  year      = {2012},
  doi       = {10.1002/9781118287422},
}"""


_TONES = """\
@article{rife1976,
  author  = {Rife, D. C. and Boorstyn, R. R.},
  title   = {Multiple tone parameter estimation from discrete-time observations},
  journal = {Bell System Technical Journal},
  volume  = {55},
  pages   = {1389--1410},
  year    = {1976},
  doi     = {10.1002/j.1538-7305.1976.tb02941.x},
}"""


def track_bibtex() -> str:
    """Entries for a track of a recorded signal."""
    return "\n\n".join([_CTID.format(version=ctid_cli.__version__), _TONES])


def bibtex(result: Identification) -> str:
    """Entries for a fit and for the frequency response that stands beside it."""
    method = _ADDITIVE if result.options.kind == "additive_srivc" else _PROJECTION
    entries = [_CTID.format(version=ctid_cli.__version__), method]
    if result.fit.weighting is not None:
        entries.append(_ROBUST)
    if result.uncertainty.kind in ("robust", "bootstrap"):
        entries.append(_LIKELIHOOD)
    return "\n\n".join([*entries, _FREQUENCY])
