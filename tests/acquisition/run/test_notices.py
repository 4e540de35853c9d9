"""Who is told of a run, and what: commands and URLs that get notices, systemd and a dead man's switch that it lives."""

from __future__ import annotations

import base64
import http.server
import json
import os
import shlex
import socket
import sys
import threading
import time
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from acquisition.run import run
from acquisition.run.run import ALIVE_S, Life, Notices, take_session
from drivers.presenter import Colour
from experiment.config import NotifySettings
from experiment.lights import Illumination
from foundation.clock import SimulatedClock
from foundation.errors import DeviceError
from tests.acquisition.run.scripted import SETTINGS, Lab

AT = datetime(2026, 1, 1, 3, 12, 45, tzinfo=UTC)


@dataclass
class Receiver:
    """What a server on this machine got, and how it answers."""

    code: int = 200
    headers: dict[str, str] = field(default_factory=dict[str, str])
    hangs: threading.Event | None = None
    port: int = 0
    got: list[tuple[str, dict[str, str], dict[str, Any]]] = field(
        default_factory=list[tuple[str, dict[str, str], dict[str, Any]]]
    )


@contextmanager
def served(receiver: Receiver) -> Generator[Receiver]:
    class Handler(http.server.BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            receiver.got.append((self.path, dict(self.headers), json.loads(body)))
            if receiver.hangs is not None:
                receiver.hangs.wait(10)
            self.send_response(receiver.code)
            for name, value in receiver.headers.items():
                self.send_header(name, value)
            self.end_headers()

        do_GET = do_POST  # noqa: N815

        def log_message(self, format: str, *args: object) -> None: ...

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        receiver.port = server.server_address[1]
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        try:
            yield receiver
        finally:
            if receiver.hangs is not None:
                receiver.hangs.set()
            server.shutdown()
            thread.join()


@pytest.fixture(autouse=True)
def no_proxy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("no_proxy", "127.0.0.1")


def told(target: str, *events: str) -> list[str]:
    """Tell a target some events; return the warnings."""
    warnings: list[str] = []
    told_by = Notices(target, "night", warnings.append)
    for event in events or ("paused",):
        told_by.tell(event, "the screen is covered – 3 °C", AT)
    told_by.close()
    told_by.close()
    return warnings


class TestWebhook:
    def test_it_gets_json(self) -> None:
        with served(Receiver()) as receiver:
            assert told(f"http://127.0.0.1:{receiver.port}/lab?token=t", "paused", "resumed") == []
        (path, headers, body), (_, _, second) = receiver.got
        assert path == "/lab?token=t"
        assert headers["Content-Type"] == "application/json; charset=utf-8"
        assert headers["Title"] == "CroP: paused"
        assert body == {
            "event": "paused",
            "message": "the screen is covered – 3 °C",
            "text": "night: paused: the screen is covered – 3 °C",
            "content": "night: paused: the screen is covered – 3 °C",
            "session": "night",
            "host": socket.gethostname(),
            "at": "2026-01-01T03:12:45+00:00",
        }
        assert second["event"] == "resumed"

    def test_a_user_and_a_password_become_a_header(self) -> None:
        with served(Receiver()) as receiver:
            assert told(f"http://u%40x:p%3Aw@127.0.0.1:{receiver.port}/lab") == []
        ((path, headers, _),) = receiver.got
        assert path == "/lab"
        assert "u%40x" not in headers["Host"]
        assert base64.b64decode(headers["Authorization"].removeprefix("Basic ")) == b"u@x:p:w"

    @pytest.mark.parametrize(
        ("receiver", "why"),
        [
            (Receiver(403), "it answered 403"),
            (Receiver(500), "it answered 500"),
            (Receiver(302, {"Location": "/elsewhere"}), "it answered 302"),
        ],
    )
    def test_a_refusal_is_said_once_and_without_the_secret(self, receiver: Receiver, why: str) -> None:
        with served(receiver):
            warnings = told(f"http://u:s3cret@127.0.0.1:{receiver.port}/s3cret?s3cret", "paused", "resumed")
        assert warnings == [f"http://127.0.0.1:{receiver.port}/… could not be told: {why}; the run goes on without"]
        assert len(receiver.got) == 2

    def test_a_server_that_is_not_there(self) -> None:
        with socket.create_server(("127.0.0.1", 0)) as unused:
            port = unused.getsockname()[1]
        (warning,) = told(f"http://127.0.0.1:{port}/s3cret")
        assert "Connection refused" in warning
        assert "s3cret" not in warning

    @pytest.mark.slow
    def test_a_server_that_hangs_is_not_waited_for(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(run, "LIMIT_S", 0.1)
        monkeypatch.setattr(run, "ENDING_S", 0.1)
        with served(Receiver(hangs=threading.Event())) as receiver:
            warnings = told(f"http://127.0.0.1:{receiver.port}/s3cret", "paused", "resumed", "complete")
        assert warnings
        assert all("s3cret" not in warning for warning in warnings)


class TestCommand:
    @pytest.mark.slow
    def test_it_gets_json_and_variables(self, tmp_path: Path) -> None:
        out = tmp_path / "got"
        program = (
            "import json, os, sys; body = json.load(sys.stdin);"
            "open(sys.argv[1], 'a').write(repr((body['message'], os.environ['CROP_EVENT'], os.environ['CROP_MESSAGE'],"
            "os.environ['CROP_SESSION'])) + '\\n')"
        )
        assert told(shlex.join([sys.executable, "-c", program, str(out)]), "paused", "resumed") == []
        said = "the screen is covered – 3 °C"
        lines = [repr((said, event, said, "night")) for event in ("paused", "resumed")]
        assert out.read_text().splitlines() == lines

    @pytest.mark.parametrize(
        ("target", "label", "why"),
        [
            ("false s3cret", "false …", "it ended with 1, 0 expected"),
            ("/nowhere/notify s3cret", "/nowhere/notify …", "No such file or directory"),
            ("true s3cret", "", ""),
        ],
    )
    def test_how_it_ends_is_said(self, target: str, label: str, why: str) -> None:
        expected = [f"{label} could not be told: {why}; the run goes on without"] if why else []
        assert told(target, "paused", "resumed") == expected

    @pytest.mark.slow
    def test_one_that_hangs_is_ended_with_what_it_started(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(run, "LIMIT_S", 0.5)
        numbers = tmp_path / "pids"
        (warning,) = told(f"sh -c 'sleep 600 & echo $$ $! > {numbers}; wait'")
        assert "within 0.5 s" in warning
        for number in numbers.read_text().split():
            # It is gone, or what is left of it waits to be read by init.
            stat, until = Path(f"/proc/{number}/stat"), time.monotonic() + 10
            while stat.exists() and stat.read_text().rpartition(")")[2].split()[0] not in "ZX":
                assert time.monotonic() < until


@pytest.mark.slow
def test_telling_takes_no_time_and_loses_what_nobody_takes() -> None:
    with served(Receiver(hangs=threading.Event())) as receiver:
        told_by = Notices(f"http://127.0.0.1:{receiver.port}/", "night")
        for number in range(3 * run.QUEUED):
            told_by.tell(f"event {number}", "", AT)
        assert len(receiver.got) <= 1
        assert receiver.hangs is not None
        receiver.hangs.set()
        told_by.close()
        assert len(receiver.got) <= run.QUEUED + 2


class Manager:
    """Takes datagrams as systemd does."""

    def __init__(self, address: str) -> None:
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.bind(address.replace("@", "\0", 1) if address.startswith("@") else address)
        self.socket.setblocking(False)

    def got(self) -> list[str]:
        texts: list[str] = []
        while True:
            try:
                texts.append(self.socket.recv(4096).decode())
            except BlockingIOError:
                return texts


@pytest.fixture(params=["path", "abstract"])
def address(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    return str(tmp_path / "notify") if request.param == "path" else f"@crop-test-{os.getpid()}"


@pytest.fixture
def manager(address: str) -> Generator[Manager]:
    one = Manager(address)
    with one.socket:
        yield one


def life(address: str, clock: SimulatedClock, **more: str) -> Life:
    return Life("", "night", lambda sentence: None, clock, {"NOTIFY_SOCKET": address, **more})


def test_a_service_manager_is_fed_within_half_of_its_time(manager: Manager, address: str) -> None:
    clock = SimulatedClock()
    one = life(address, clock, WATCHDOG_USEC="60000000")
    one.ready()
    assert manager.got() == ["READY=1", "WATCHDOG=1\nSTATUS=at work"]
    fed: list[float] = [0.0]
    for _ in range(60):
        clock.sleep(5)
        one.sign("frame\n3")
        fed += [clock.monotonic()] * len(manager.got())
    assert max(later - earlier for earlier, later in pairwise(fed)) <= 30
    assert len(fed) <= 21
    one.end("complete", "0 of 6 frames left")
    assert manager.got() == ["STOPPING=1\nSTATUS=complete: 0 of 6 frames left"]


def test_a_dead_mans_switch_hears_each_minute(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, told = SimulatedClock(), list[float]()

    def tell(*_: object) -> None:
        told.append(clock.monotonic() - begun)

    monkeypatch.setattr(Notices, "tell", tell)
    one, begun = Life("switch", "night", lambda sentence: None, clock, {}), clock.monotonic()
    for _ in range(7):
        one.sign("takes frames")
        clock.sleep(ALIVE_S / 2)
    assert told == [0, ALIVE_S, 2 * ALIVE_S, 3 * ALIVE_S]
    one.close()


def test_a_run_tells_a_service_manager(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    manager = Manager(str(tmp_path / "notify"))
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
    lab = Lab(tmp_path / "session")
    with manager.socket:
        assert take_session(lab.session, lab.devices, SETTINGS).complete
        got = manager.got()
    assert got[0] == "READY=1"
    assert len([text for text in got if text.startswith("WATCHDOG=1")]) >= 6, "each frame is a sign"
    assert got[-1].startswith("STOPPING=1\nSTATUS=complete")


@pytest.mark.slow
def test_who_could_not_be_told_is_noted_while_the_run_goes_on(tmp_path: Path) -> None:
    gone = str(tmp_path / "gone")
    sequence = SETTINGS.sequence.model_copy(update={"notify": f"{gone} s3cret"})
    settings = SETTINGS.model_copy(update={"sequence": sequence, "notify": NotifySettings(alive=f"{gone} s3cret")})
    lights = tuple(Illumination(n, "uniform", None, Colour(255, n, 0)) for n in range(2))
    lab = Lab(tmp_path / "session", lights=lights)
    lab.screen.fails = dict.fromkeys(range(2, 40), DeviceError("a screen saver covers the picture"))
    assert take_session(lab.session, lab.devices, settings).complete
    events = lab.session.journal.events()
    doubts = [event.detail for event in events if event.what == "doubt"]
    assert sorted(doubt.partition(":")[0] for doubt in doubts) == ["notify.alive", "sequence.notify"], "once a cause"
    assert all(gone in doubt and "s3cret" not in doubt for doubt in doubts)


@pytest.mark.slow
def test_a_dead_mans_switch_hears_of_frames_and_pauses_and_of_the_end(tmp_path: Path) -> None:
    heard = tmp_path / "heard"
    program = f"import sys; open({str(heard)!r}, 'a').write(sys.stdin.read() + chr(10))"
    target = shlex.join([sys.executable, "-S", "-c", program])
    settings = SETTINGS.model_copy(update={"notify": NotifySettings(alive=target)})
    lights = tuple(Illumination(n, "uniform", None, Colour(255, n, 0)) for n in range(2))
    lab = Lab(tmp_path / "session", lights=lights)
    lab.screen.fails = dict.fromkeys(range(2, 40), DeviceError("a screen saver covers the picture"))
    assert take_session(lab.session, lab.devices, settings).complete
    told: list[dict[str, Any]] = [json.loads(line) for line in heard.read_text().splitlines()]
    assert [one["event"] for one in told] == ["alive"] * (len(told) - 1) + ["complete"]
    assert 2 <= len(told) - 1 <= lab.clock.monotonic() / ALIVE_S + 1
    assert any("screen saver" in one["message"] for one in told), "a run that waits is alive"
