"""Maximum-likelihood estimation of the model of RIVC, plant and noise."""

from dataclasses import dataclass
from typing import ClassVar

from ctid_cli.estimators.delay_profile import DelayProfile


@dataclass(frozen=True)
class Rivc(DelayProfile):
    """Transfer function with a delay and an ARMA model of the output noise, by maximum likelihood.

    Parameters
    ----------
    noise_model : str, default "auto"
        ``arma:P,Q``, ``auto`` for the orders up to 3 of least BIC, or ``white``.

    Raises
    ------
    ValueError
        If an option is out of range.

    Notes
    -----
    All other options are those of :class:`~ctid_cli.estimators.delay_profile.DelayProfile`. The model is that of the
    RIVC method, a continuous-time plant with discrete-time noise [1]_, whose iteration approaches the same estimate.

    References
    ----------
    .. [1] P. C. Young, "The refined instrumental variable method: unified estimation of discrete and continuous-time
       transfer function models", *Journal Européen des Systèmes Automatisés* 42 (2008) 149-179.
       doi:10.3166/jesa.42.149-179
    """

    kind: ClassVar[str] = "rivc"

    noise_model: str = "auto"
