"""Classes of all values of ``kind`` in a specification: the single list of available components.

The classes belong to several layers; each is imported on first use.
"""

import importlib
from typing import Any

_NOISES = {
    "white": "ctid_cli.signals.noise:WhiteNoise",
    "arma": "ctid_cli.signals.noise:ArmaNoise",
}
#: Section or part of it, to allowed kinds, to the place of each class: ``module:Class``.
KINDS: dict[str, dict[str, str]] = {
    "excitation": {
        "prbs": "ctid_cli.signals.excitation:Prbs",
        "gbn": "ctid_cli.signals.excitation:Gbn",
        "multisine": "ctid_cli.signals.multisine:Multisine",
        "gaussian": "ctid_cli.signals.excitation:Gaussian",
        "step": "ctid_cli.signals.excitation:Step",
        "steps": "ctid_cli.signals.excitation:Steps",
        "file": "ctid_cli.signals.excitation:InputFile",
    },
    "sampling": {
        "regular": "ctid_cli.signals.sampling:RegularSampling",
        "irregular": "ctid_cli.signals.sampling:IrregularSampling",
        "uniform_intervals": "ctid_cli.signals.sampling:UniformIntervals",
        "jitter": "ctid_cli.signals.sampling:JitteredSampling",
    },
    "noise": _NOISES,
    "disturbance": {
        "uniform": "ctid_cli.signals.sinusoids:UniformDisturbance",
        "sine": "ctid_cli.signals.sinusoids:SineDisturbance",
        **_NOISES,
    },
    "estimator": {
        "svf": "ctid_cli.estimators.svf:Svf",
        "srivc": "ctid_cli.estimators.srivc:Srivc",
        "td_srivc": "ctid_cli.estimators.td_srivc:TdSrivc",
        "useful_redundancy": "ctid_cli.estimators.useful_redundancy:UsefulRedundancy",
        "delay_profile": "ctid_cli.estimators.delay_profile:DelayProfile",
        "rivc": "ctid_cli.estimators.rivc:Rivc",
        "additive_srivc": "ctid_cli.estimators.additive_srivc:AdditiveSrivc",
        "additive_output_error": "ctid_cli.estimators.additive_output_error:AdditiveOutputError",
        "loop_output_error": "ctid_cli.estimators.loop_output_error:LoopOutputError",
    },
    "frequency_estimator": {
        "drem_gradient": "ctid_cli.frequency.drem:DremGradient",
        "drem_finite_time": "ctid_cli.frequency.drem:DremFiniteTime",
        "drem_window": "ctid_cli.frequency.drem:DremWindow",
        "restarting_least_squares": "ctid_cli.frequency.restarting_least_squares:RestartingLeastSquares",
    },
}


def resolve(section: str, kind: str) -> type[Any]:
    """Return the class of a kind."""
    module, _, name = KINDS[section][kind].partition(":")
    found: type[Any] = getattr(importlib.import_module(module), name)
    return found


def classes(section: str) -> dict[str, type[Any]]:
    """Return all classes of a section by kind."""
    return {kind: resolve(section, kind) for kind in KINDS[section]}
