"""Worker processes: how they are set up, and how they end with their parent."""

import ctypes
import faulthandler
import os
import signal
import sys
import threading
import time
import warnings

_PR_SET_PDEATHSIG = 1


def initialise(parent: int) -> None:
    """Set up a new worker process.

    The parent alone decides what an interrupt means, so the worker ignores it. A worker must not outlive its parent,
    however the parent died: Linux can be asked to see to that, elsewhere a thread looks now and then.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    # What an estimator of one's own prints must not stand between the lines of an answer.
    sys.stdout = sys.stderr
    # Estimators report through their status; warnings of several workers at once would only garble the terminal.
    warnings.simplefilter("ignore")
    faulthandler.disable()
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:
            os._exit(1)
    else:
        threading.Thread(target=_watch, args=(parent,), daemon=True).start()


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(1.0)
    os._exit(1)
