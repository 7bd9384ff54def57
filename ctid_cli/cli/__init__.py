"""The command line: one file per command."""

import os
import signal
from types import FrameType


def _end(number: int, frame: FrameType | None) -> None:
    """End the process by Ctrl-C before its command begins, such as while modules are imported."""
    os.write(2, b"ctid: interrupted; nothing was written\n")
    os._exit(130)


def main() -> None:
    """Run the ``ctid`` command."""
    # A process in the background of a script ignores SIGINT.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _end)
    from ctid_cli.cli.main import main as run

    run()
