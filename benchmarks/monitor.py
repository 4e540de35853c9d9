"""What the monitor's page costs a machine that takes a session: processor time and bytes of each answer.

`python -m benchmarks.monitor` prints one JSON object a line: the page itself; all of a session of the paper's 707
lights with 800 attempts and 12 checks each, which a page asks for once; what one more frame adds; a sign of life; and
the answer that nothing is new, which is most of them. A page asks every two seconds.

Last, how long viewers wait beside an attack from their own address: connections whose request trickles in, a byte a
second, others that never send one, each made anew when it is closed, and viewers with a new connection for each answer.
"""

from __future__ import annotations

import gzip
import json
import socket
import tempfile
import time
import urllib.request
from collections.abc import Callable
from contextlib import closing
from datetime import UTC, datetime, timedelta
from pathlib import Path
from threading import Event, Thread
from typing import Any

from acquisition.monitor.serving import open_monitor
from drivers.camera import CapturedFrame
from experiment.lights import plan_illuminations, save_illuminations
from experiment.session.journal import JOURNAL_FILE, Journal, ReceivedFile
from experiment.session.records import RESPONSE, Check, Judgement, SessionStep, plan_steps

# Attempts of a night: 707 lights, references, response frames, and some that were refused.
ATTEMPTS = 800

# Checks of a frame.
CHECKS = 12

# Answers of each kind of which the fastest counts: other programs only make them slower.
REPEATS = 15

# Connections of the attack, viewers, and answers that each of them asks for.
TRICKLING, SILENT, VIEWERS, ANSWERS = 64, 400, 4, 100

BEGUN = datetime(2026, 1, 1, 22, 0, tzinfo=UTC)


class _Night:
    """A session whose journal grows."""

    def __init__(self, folder: Path) -> None:
        lights = plan_illuminations()
        self.steps = plan_steps(lights, 25, seed=1, response=RESPONSE)
        self._taken = 0
        save_illuminations(lights, folder / "illuminations.csv")
        Journal.create(folder / JOURNAL_FILE, self.steps)
        self.journal = Journal.open_for_run(folder / JOURNAL_FILE)

    def take(self) -> None:
        """Take one more frame."""
        step: SessionStep = self.steps[self._taken % len(self.steps)]
        at = BEGUN + timedelta(seconds=3 * self._taken)
        self._taken += 1
        checks = tuple(
            Check(f"check {number}", 1 / (number + self._taken), None, 3.25, "%") for number in range(CHECKS)
        )
        attempt = self.journal.begin(step, f"frames/{step.stem}", at)
        self.journal.commit(
            attempt,
            ReceivedFile(
                self.journal.path.parent / f"frames/{step.stem}.cr2", 1, "0" * 64, CapturedFrame("1.cr2", 1, at)
            ),
            Judgement(checks, (1000.5, 2000.25, 1500.75), bytes(4000)),
            {"show": 0.01, "settle": 0.2, "expose": 0.6, "download": 0.8, "save": 0.3, "judge": 0.5},
            exposure_s=0.5,
            ended_at=at + timedelta(seconds=3),
        )

    def beat(self) -> None:
        """Give a sign of life."""
        self.journal.beat("running", f"frame {self._taken}", datetime.now(UTC) + timedelta(seconds=10))


def _ask(url: str) -> bytes:
    request = urllib.request.Request(url, headers={"Accept-Encoding": "gzip"})
    with urllib.request.urlopen(request) as answer:
        return answer.read()


def _cost(address: str, what: str, cursor: Callable[[], str], before: Callable[[], None]) -> dict[str, Any]:
    """Return the fastest of several answers, after something has happened, and its bytes on the wire and unpacked."""
    best, sizes = float("inf"), (0, 0)
    for _ in range(REPEATS):
        since = cursor()
        before()
        begun = time.perf_counter()
        body = _ask(f"{address}state.json?since={since}")
        best = min(best, time.perf_counter() - begun)
        sizes = (len(body), len(gzip.decompress(body) if body[:2] == b"\x1f\x8b" else body))
    return {"answer": what, "ms": round(1000 * best, 2), "bytes": sizes[0], "unpacked": sizes[1]}


def _besieged(port: int) -> dict[str, Any]:
    """Return how long each answer took beside `TRICKLING` slow and `SILENT` silent connections, seconds."""
    ended = Event()

    def attack(words: bytes) -> None:
        links: list[socket.socket] = []
        while not ended.wait(1.0):
            alive: list[socket.socket] = []
            for link in links or [None] * (TRICKLING if words else SILENT):
                try:
                    made = link or socket.create_connection(("127.0.0.1", port), timeout=5)
                    made.sendall(words)
                    alive.append(made)
                except OSError:
                    alive.append(socket.create_connection(("127.0.0.1", port), timeout=5))
            links = alive

    took: list[float] = []

    def view() -> None:
        for _ in range(ANSWERS):
            start = time.perf_counter()
            _ask(f"http://127.0.0.1:{port}/")
            took.append(time.perf_counter() - start)
            time.sleep(0.2)

    attackers = [Thread(target=attack, args=(words,), daemon=True) for words in (b"G", b"")]
    viewers = [Thread(target=view) for _ in range(VIEWERS)]
    for thread in attackers:
        thread.start()
    time.sleep(3)
    for thread in viewers:
        thread.start()
    for thread in viewers:
        thread.join()
    ended.set()
    return {
        "beside": f"{TRICKLING} trickling and {SILENT} silent connections",
        "answers": len(took),
        "asked": VIEWERS * ANSWERS,
        "median_s": round(sorted(took)[len(took) // 2], 4),
        "longest_s": round(max(took), 4),
    }


def main() -> None:
    """Print the costs."""
    with tempfile.TemporaryDirectory(prefix="crop-") as scratch:
        night = _Night(Path(scratch))
        with closing(night.journal):
            for _ in range(ATTEMPTS):
                night.take()
            night.beat()
            with open_monitor(Path(scratch), 0) as server:
                Thread(target=server.serve_forever, daemon=True).start()
                address = f"http://127.0.0.1:{server.port}/"

                def now() -> str:
                    state = server.watch.state()
                    assert state is not None
                    return str(state["cursor"])

                page = _ask(address)
                print(json.dumps({"answer": "page", "bytes": len(page), "unpacked": len(gzip.decompress(page))}))
                costs = (
                    ("all", lambda: "", lambda: None),
                    ("one more frame", now, night.take),
                    ("a sign of life", now, night.beat),
                    ("nothing new", now, lambda: None),
                )
                for what, cursor, before in costs:
                    print(json.dumps(_cost(address, what, cursor, before)), flush=True)
                print(json.dumps(_besieged(server.port)), flush=True)
                server.shutdown()


if __name__ == "__main__":
    main()
