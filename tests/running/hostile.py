"""Misbehaving estimators: they exceed limits, fail, or lack machine resources."""

from __future__ import annotations

import errno
import itertools
import os
import signal
import time
from pathlib import Path

import numpy as np


def for_ever() -> None:
    """Loop in compiled code, which Python cannot interrupt."""
    sum(itertools.repeat(0))


class SpeechlessError(Exception):
    def __str__(self) -> str:
        raise RuntimeError("no words")


def misbehave(mischief: str, marker: str) -> None:
    match mischief:
        case "raise":
            raise ZeroDivisionError(f"{object()} is no good")
        case "speak in halves":
            raise ValueError("half a character: \ud83d, a \0 and\x1b[31m red")
        case "be speechless":
            raise SpeechlessError
        case "exit":
            raise SystemExit(3)
        case "leave":
            os._exit(3)
        case "die":
            os.kill(os.getpid(), signal.SIGSEGV)
        case "be killed":
            os.kill(os.getpid(), signal.SIGKILL)
        case "be killed once":
            Path(marker).touch()
            os.kill(os.getpid(), signal.SIGKILL)
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
        case "fill the disk":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        case "open files":
            kept = [os.open("/dev/null", os.O_RDONLY) for _ in range(1_000_000)]
