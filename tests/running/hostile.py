"""Estimators that take more than they may, or that the machine does not let finish."""

from __future__ import annotations

import math
import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path

import numba
import numpy as np

from tests.running.fakes import FakeFit, FakeRecord, FakeStart, Prepared, Toy


@numba.njit(cache=True)
def for_ever(x: float) -> float:
    while x < 2.0:
        x = math.sin(x)
    return x


@dataclass(frozen=True)
class Hostile(Toy):
    """Its mischief happens in replicate `at`; where there is a marker, only until that file is there."""

    def prepare(self, record: FakeRecord) -> Prepared:
        if self.mischief == "hang in preparation" and record.replicate == self.at:
            for_ever(1.0)
        return HostilePrepared(self, record)


@dataclass(frozen=True)
class HostilePrepared(Prepared):
    def fit(self, start: FakeStart | None) -> FakeFit:
        toy = self.toy
        if self.record.replicate == toy.at and not (toy.marker and Path(toy.marker).exists()):
            misbehave(toy.mischief)
        return super().fit(start)


def misbehave(mischief: str) -> None:
    match mischief:
        case "loop":
            for_ever(1.0)
        case "stop":
            os.kill(os.getpid(), signal.SIGSTOP)
        case "sleep":
            time.sleep(1e6)
        case "grow":
            kept = []
            while True:
                kept.append(np.ones(1_000_000))
        case "ask for too much":
            np.empty(2**45)
        case "be killed":
            os.kill(os.getpid(), signal.SIGKILL)
        case "open files":
            kept = [os.open("/dev/null", os.O_RDONLY) for _ in range(1_000_000)]
        case "speak in halves":
            raise ValueError("half a character: \ud83d, a \0 and\x1b[31m red")
        case "be speechless":
            raise SpeechlessError
        case "leave":
            os._exit(3)


class SpeechlessError(Exception):
    def __str__(self) -> str:
        raise RuntimeError("no words")
