"""Sessions with mishaps of every kind, by seed: run by hand, never by pytest.

    python -m tests.fuzz.fuzz_mishaps --count 1000 [--from 1000]

What must hold stands in `tests.acquisition.run.mishaps.take_all`; fifty of them are
`tests/end_to_end/test_mishaps.py`.
"""

from __future__ import annotations

import argparse
import tempfile
import traceback
from pathlib import Path

from tests.acquisition.run.mishaps import take_all


def main() -> int:
    """Take sessions; print which went wrong, and return how many did, 99 at most."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=1000, help="sessions")
    parser.add_argument("--from", dest="first", type=int, default=1000, help="first seed")
    chosen = parser.parse_args()
    memory = "/dev/shm" if Path("/dev/shm").is_dir() else None
    complete = wrong = 0
    for seed in range(chosen.first, chosen.first + chosen.count):
        with tempfile.TemporaryDirectory(prefix="crop-mishaps-", dir=memory) as folder:
            try:
                complete += take_all(Path(folder) / "session", seed)
            except Exception:
                wrong += 1
                print(f"--from {seed} --count 1", traceback.format_exc(limit=-6), sep="\n", flush=True)
    print(f"{chosen.count} sessions, {complete} complete at once, {wrong} went wrong")
    return min(wrong, 99)


if __name__ == "__main__":
    raise SystemExit(main())
