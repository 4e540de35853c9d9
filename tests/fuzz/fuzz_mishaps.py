"""Sessions with mishaps of every kind, by seed; run it by hand, not with pytest.

    python -m tests.fuzz.fuzz_mishaps --count 1000 [--from 1000]

The requirements are in `tests.acquisition.run.mishaps.take_all`; `tests/end_to_end/test_mishaps.py` is a short run.
"""

from __future__ import annotations

import argparse
import tempfile
import traceback
from pathlib import Path

from tests.acquisition.run.mishaps import take_all


def main() -> int:
    """Take sessions and print the failed ones; return their number, at most 99."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=1000, help="number of sessions")
    parser.add_argument("--from", dest="first", type=int, default=1000, help="first seed")
    options = parser.parse_args()
    memory = "/dev/shm" if Path("/dev/shm").is_dir() else None
    complete = failures = 0
    for seed in range(options.first, options.first + options.count):
        with tempfile.TemporaryDirectory(prefix="crop-mishaps-", dir=memory) as folder:
            try:
                complete += take_all(Path(folder) / "session", seed)
            except Exception:
                failures += 1
                print(f"--from {seed} --count 1", traceback.format_exc(limit=-6), sep="\n", flush=True)
    print(f"{options.count} sessions, {complete} complete at once, {failures} failed")
    return min(failures, 99)


if __name__ == "__main__":
    raise SystemExit(main())
