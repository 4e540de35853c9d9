"""The number of processors that this process may use."""

from __future__ import annotations

import os


def processor_count() -> int:
    """Return the number of processors this process may run on, at least 1.

    A scheduler or a container may allow fewer than the machine has; systems that cannot say count all of them.
    """
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
