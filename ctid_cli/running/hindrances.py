"""What to do where the machine does not let estimates finish."""

import re

_FEWER = "use fewer worker processes (--jobs)"
#: What a reason mentions, and what helps.
_ADVICE = (
    (
        r"SIGKILL|[Oo]ut of memory|Cannot allocate",
        f"the machine was probably out of memory: {_FEWER}, close other programs, or give limits: {{memory_mb: …}} in "
        "the specification, so that what needs more is a failure of its estimator",
    ),
    (r"Too many open files", f"raise the number of open files ('ulimit -n 4096'), or {_FEWER}"),
    (r"Resource temporarily unavailable|can't start new thread", f"raise the number of processes, or {_FEWER}"),
    (r"No space left|[Dd]isk quota", "make room on the disk, also that of temporary files (TMPDIR)"),
    (r"SIGXCPU", "raise the limit of processor time of this shell or batch job ('ulimit -t')"),
)
_ANY = f"look whether something ends processes here, {_FEWER}, or try another machine"


def advice(reason: str) -> str:
    """What helps against something that stood in the way of estimates."""
    return next((text for pattern, text in _ADVICE if re.search(pattern, reason)), _ANY)
