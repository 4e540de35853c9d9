"""Fuzzing of everything that reads a folder which somebody else made: run by hand, never by pytest.

    python -m tests.fuzz.fuzz_folders --count 100000 --workers 2 [--kind table] [--from 0]

Each number is a mutated folder, the same on every machine: `--from N --count 1 --kind KIND` tries one again. What must
hold stands in `tests.fuzz.foreign.trial`; a short run of the same is `tests/end_to_end/test_foreign_folders.py`.
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

# Bytes that a process may claim: a folder of kilobytes that asks for more fails for it.
MEMORY = 8 << 30


def _work(task: tuple[dict[str, Seed], str, range]) -> list[str]:
    seeds, place, numbers = task
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    work = Path(place) / str(os.getpid())
    work.mkdir(parents=True, exist_ok=True)
    trials = Trials(work)
    found: list[str] = []
    for number in numbers:
        for kind in sorted(seeds):
            # A loop in a library hears no signal.
            faulthandler.dump_traceback_later(120, exit=True)
            (work / "number").write_text(f"{kind} {number}")
            fault = trials.judge(kind, seeds[kind], number)
            if fault is not None:
                found.append(f"--kind '{kind}' --from {number}\n{fault}")
    return found


def main() -> int:
    """Try mutated folders; print what went wrong, and return how many did, 99 at most."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=10000, help="mutated folders of each kind")
    parser.add_argument("--from", dest="first", type=int, default=0, help="first number")
    parser.add_argument("--kind", action="append", help="table, published, session, 'dataset tar' …; all by default")
    parser.add_argument("--workers", type=int, default=1)
    chosen = parser.parse_args()
    memory = "/dev/shm" if Path("/dev/shm").is_dir() else None
    faults = Counter[str]()
    with tempfile.TemporaryDirectory(prefix="crop-fuzz-", dir=memory) as place:
        seeds = make_seeds(Path(place) / "seeds")
        seeds = {kind: seed for kind, seed in seeds.items() if not chosen.kind or kind in chosen.kind}
        begun = time.monotonic()
        numbers = range(chosen.first, chosen.first + chosen.count)
        tasks = [(seeds, place, numbers[at : at + 200]) for at in range(0, len(numbers), 200)]
        # One process alone ends where a folder makes it hang; a pool would wait for it.
        tried = map if chosen.workers == 1 else multiprocessing.get_context("fork").Pool(chosen.workers).imap_unordered
        for done, found in enumerate(tried(_work, tasks), 1):
            for fault in found:
                last = fault.strip().splitlines()[-1]
                faults[last[:100]] += 1
                if faults[last[:100]] <= 2:
                    print(fault, flush=True)
            took = time.monotonic() - begun
            print(f"{done} of {len(tasks)} parts, {sum(faults.values())} faults, {took:.0f} s", flush=True)
    for fault, count in faults.most_common():
        print(f"{count:6} {fault}")
    return min(sum(faults.values()), 99)


if __name__ == "__main__":
    raise SystemExit(main())
