"""Fuzz all readers of folders received from others; run it by hand, not with pytest.

    python -m tests.fuzz.fuzz_folders --count 100000 --workers 2 [--kind table] [--from 0]

Each number is a mutated folder, the same on every machine; `--from N --count 1 --kind KIND` repeats one. The
requirements are in `tests.fuzz.foreign.trial`; `tests/end_to_end/test_foreign_folders.py` is a short run.
"""

from __future__ import annotations

import argparse
import faulthandler
import multiprocessing
import os
import resource
import tempfile
import time
from collections import Counter
from pathlib import Path

from tests.fuzz.foreign.seeds import Seed, make_seeds
from tests.fuzz.foreign.trial import Trials

# Memory limit of a process, bytes; a folder of some kilobytes must not need more.
MEMORY = 8 << 30


def _work(task: tuple[dict[str, Seed], str, range]) -> list[str]:
    seeds, scratch, numbers = task
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    work = Path(scratch) / str(os.getpid())
    work.mkdir(parents=True, exist_ok=True)
    trials = Trials(work)
    faults: list[str] = []
    for number in numbers:
        for kind in sorted(seeds):
            # A loop inside a library does not handle signals.
            faulthandler.dump_traceback_later(120, exit=True)
            (work / "number").write_text(f"{kind} {number}")
            fault = trials.judge(kind, seeds[kind], number)
            if fault is not None:
                faults.append(f"--kind '{kind}' --from {number}\n{fault}")
    return faults


def main() -> int:
    """Try mutated folders and print the faults; return their number, at most 99."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=10000, help="number of mutated folders per kind")
    parser.add_argument("--from", dest="first", type=int, default=0, help="first number")
    parser.add_argument("--kind", action="append", help="table, published, session, 'dataset tar' …; all by default")
    parser.add_argument("--workers", type=int, default=1)
    options = parser.parse_args()
    memory = "/dev/shm" if Path("/dev/shm").is_dir() else None
    faults = Counter[str]()
    with tempfile.TemporaryDirectory(prefix="crop-fuzz-", dir=memory) as scratch:
        seeds = make_seeds(Path(scratch) / "seeds")
        seeds = {kind: seed for kind, seed in seeds.items() if not options.kind or kind in options.kind}
        start_s = time.monotonic()
        numbers = range(options.first, options.first + options.count)
        tasks = [(seeds, scratch, numbers[first : first + 200]) for first in range(0, len(numbers), 200)]
        # A single process ends if a folder makes it hang; a pool would wait for it.
        run_tasks = (
            map if options.workers == 1 else multiprocessing.get_context("fork").Pool(options.workers).imap_unordered
        )
        for count, messages in enumerate(run_tasks(_work, tasks), 1):
            for fault in messages:
                last_line = fault.strip().splitlines()[-1]
                faults[last_line[:100]] += 1
                if faults[last_line[:100]] <= 2:
                    print(fault, flush=True)
            seconds = time.monotonic() - start_s
            print(f"{count} of {len(tasks)} tasks, {sum(faults.values())} faults, {seconds:.0f} s", flush=True)
    for fault, count in faults.most_common():
        print(f"{count:6} {fault}")
    return min(sum(faults.values()), 99)


if __name__ == "__main__":
    raise SystemExit(main())
