"""Random streams that depend on what they are for and on the replicate, and on nothing else."""

from __future__ import annotations

from typing import Literal

import numpy as np

Role = Literal["input", "sampling", "noise", "start", "parameters"]

#: First component of every spawn key. Results are repeatable only while these numbers stay what they are.
ROLES: dict[Role, int] = {"input": 0, "sampling": 1, "noise": 2, "start": 3, "parameters": 4}


def stream(seed: int, role: Role, replicate: int) -> np.random.Generator:
    """Random numbers of one role in one replicate.

    Parameters
    ----------
    seed : int
        Seed of the experiment, zero or positive.
    role : {"input", "sampling", "noise", "start", "parameters"}
        What the numbers are for; the last two are for initial delays and for initial parameters.
    replicate : int
        Number of the data set, from 0.

    Returns
    -------
    numpy.random.Generator
        A new generator at the beginning of its stream.

    Notes
    -----
    Levels (noise power, record length, estimators) do not enter, so every level of an experiment sees the
    same input and the same noise shape in the same replicate, and adding a level changes no other.

    Examples
    --------
    >>> from ctid_cli.signals import stream
    >>> first = stream(1, "noise", 0).standard_normal(4)
    >>> bool((first == stream(1, "noise", 0).standard_normal(4)).all())
    True
    """
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(ROLES[role], replicate)))
