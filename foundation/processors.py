"""The number of processors that this process may use."""

from __future__ import annotations

import os


def processor_count() -> int:
    """Return the number of processors this process may run on, at least 1.

    A scheduler or a container may bind a process to fewer than the machine has; where the system binds none, all are
    counted. A container's share of processor time is not looked at.
    """
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
