"""Random streams that depend on what they are for and on the replicate, and on nothing else."""

from typing import Literal

import numpy as np

Role = Literal["input", "sampling", "noise", "start", "parameters", "recorder"]

#: First component of every spawn key. Results are repeatable only while these numbers stay what they are.
ROLES: dict[Role, int] = {"input": 0, "sampling": 1, "noise": 2, "start": 3, "parameters": 4, "recorder": 5}


def stream(seed: int, role: Role, replicate: int) -> np.random.Generator:
    """Random numbers of one role in one replicate.

    Levels (noise power, record length, estimators) do not enter, so every level of an experiment sees the
    same input and the same noise shape in the same replicate, and adding a level changes no other.
    """
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(ROLES[role], replicate)))
