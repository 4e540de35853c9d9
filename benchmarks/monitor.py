"""Cost of the monitor page for a machine that takes a session: processor time and bytes of each answer.

`python -m benchmarks.monitor` prints one JSON object for each kind of answer: the page itself; a whole session of 707
illuminants with 800 attempts and 12 checks each, which a page requests once; one more frame; a heartbeat; and the
answer without news, which is the most frequent. A page sends a request every two seconds.

The last result is the waiting time of viewers during an attack from the address of the viewers. Some attacking
connections send a byte per second, others send nothing. Each attacking connection is opened again when it is closed.
Viewers open a connection per answer.
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
from experiment.lights import plan_illuminants, save_illuminants
from experiment.session.journal import JOURNAL_FILE, Journal, ReceivedFile
from experiment.session.records import RESPONSE, Check, Judgement, SessionStep, plan_steps

# Attempts of a night: 707 illuminants, references, response frames, and some refused frames.
ATTEMPTS = 800

# Checks per frame.
CHECKS = 12

# Repetitions of each answer; the fastest counts, because other programs only slow it down.
REPEATS = 15

# Connections of the attack (sending, silent), viewers, and answers per viewer.
TRICKLING, SILENT, VIEWERS, ANSWERS = 64, 400, 4, 100

STARTED_AT = datetime(2026, 1, 1, 22, 0, tzinfo=UTC)


class _Night:
    """A session with a growing journal."""

    def __init__(self, folder: Path) -> None:
        lights = plan_illuminants()
        self.steps = plan_steps(lights, 25, seed=1, response=RESPONSE)
        self._frame_count = 0
        save_illuminants(lights, folder / "illuminations.csv")
        Journal.create(folder / JOURNAL_FILE, self.steps)
        self.journal = Journal.open_for_run(folder / JOURNAL_FILE)

    def take(self) -> None:
        step: SessionStep = self.steps[self._frame_count % len(self.steps)]
        started_at = STARTED_AT + timedelta(seconds=3 * self._frame_count)
        self._frame_count += 1
        checks = tuple(
            Check(f"check {number}", 1 / (number + self._frame_count), None, 3.25, "%") for number in range(CHECKS)
        )
        attempt = self.journal.begin(step, f"frames/{step.stem}", started_at)
        self.journal.commit(
            attempt,
            ReceivedFile(
                self.journal.path.parent / f"frames/{step.stem}.cr2", 1, "0" * 64, CapturedFrame("1.cr2", 1, started_at)
            ),
            Judgement(checks, (1000.5, 2000.25, 1500.75), bytes(4000)),
            {"show": 0.01, "settle": 0.2, "expose": 0.6, "download": 0.8, "save": 0.3, "judge": 0.5},
            exposure_s=0.5,
            ended_at=started_at + timedelta(seconds=3),
        )

    def beat(self) -> None:
        """Write a heartbeat."""
        self.journal.beat("running", f"frame {self._frame_count}", datetime.now(UTC) + timedelta(seconds=10))


def _request(url: str) -> bytes:
    request = urllib.request.Request(url, headers={"Accept-Encoding": "gzip"})
    with urllib.request.urlopen(request) as response:
        return response.read()


def _cost(address: str, answer: str, cursor: Callable[[], str], make_event: Callable[[], None]) -> dict[str, Any]:
    """Return the fastest of several answers after an event, with its size on the wire and unpacked."""
    fastest_s, sizes = float("inf"), (0, 0)
    for _ in range(REPEATS):
        cursor_value = cursor()
        make_event()
        start_s = time.perf_counter()
        body = _request(f"{address}state.json?since={cursor_value}")
        fastest_s = min(fastest_s, time.perf_counter() - start_s)
        sizes = (len(body), len(gzip.decompress(body) if body[:2] == b"\x1f\x8b" else body))
    return {"answer": answer, "ms": round(1000 * fastest_s, 2), "bytes": sizes[0], "unpacked": sizes[1]}


def _attacked(port: int) -> dict[str, Any]:
    """Return the answer times of viewers during the attack, in seconds."""
    stop = Event()

    def attack(request: bytes) -> None:
        links: list[socket.socket] = []
        while not stop.wait(1.0):
            open_links: list[socket.socket] = []
            for link in links or [None] * (TRICKLING if request else SILENT):
                try:
                    connection = link or socket.create_connection(("127.0.0.1", port), timeout=5)
                    connection.sendall(request)
                    open_links.append(connection)
                except OSError:
                    open_links.append(socket.create_connection(("127.0.0.1", port), timeout=5))
            links = open_links

    times: list[float] = []

    def view() -> None:
        for _ in range(ANSWERS):
            start = time.perf_counter()
            _request(f"http://127.0.0.1:{port}/")
            times.append(time.perf_counter() - start)
            time.sleep(0.2)

    attackers = [Thread(target=attack, args=(request,), daemon=True) for request in (b"G", b"")]
    viewers = [Thread(target=view) for _ in range(VIEWERS)]
    for thread in attackers:
        thread.start()
    time.sleep(3)
    for thread in viewers:
        thread.start()
    for thread in viewers:
        thread.join()
    stop.set()
    return {
        "beside": f"{TRICKLING} trickling and {SILENT} silent connections",
        "answers": len(times),
        "asked": VIEWERS * ANSWERS,
        "median_s": round(sorted(times)[len(times) // 2], 4),
        "longest_s": round(max(times), 4),
    }


def main() -> None:
    with tempfile.TemporaryDirectory(prefix="crop-") as scratch:
        night = _Night(Path(scratch))
        with closing(night.journal):
            for _ in range(ATTEMPTS):
                night.take()
            night.beat()
            with open_monitor(Path(scratch), 0) as server:
                Thread(target=server.serve_forever, daemon=True).start()
                address = f"http://127.0.0.1:{server.port}/"

                def current_cursor() -> str:
                    state = server.watch.state()
                    assert state is not None
                    return str(state["cursor"])

                page = _request(address)
                print(json.dumps({"answer": "page", "bytes": len(page), "unpacked": len(gzip.decompress(page))}))
                costs = (
                    ("all", lambda: "", lambda: None),
                    ("one more frame", current_cursor, night.take),
                    ("a heartbeat", current_cursor, night.beat),
                    ("nothing new", current_cursor, lambda: None),
                )
                for answer, cursor, make_event in costs:
                    print(json.dumps(_cost(address, answer, cursor, make_event)), flush=True)
                print(json.dumps(_attacked(server.port)), flush=True)
                server.shutdown()


if __name__ == "__main__":
    main()
