"""Signs of life for systemd and for a dead man's switch: they come from the run's steps, and stop with them."""

from __future__ import annotations

import json
import os
import shlex
import socket
import sys
from collections.abc import Generator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from acquisition.run.notices import ALIVE_S, Life
from acquisition.run.run import take_session
from drivers.presenter import Colour
from experiment.config import NotifySettings
from experiment.lights import Illumination
from foundation.clock import SimulatedClock
from foundation.errors import DeviceError
from tests.acquisition.run.scripted import SETTINGS, Lab


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


@pytest.mark.parametrize(
    "environment", [{}, {"NOTIFY_SOCKET": "/nowhere/notify"}, {"NOTIFY_SOCKET": "vsock:2:1", "WATCHDOG_USEC": "soon"}]
)
def test_no_manager_hurts_nobody(environment: dict[str, str]) -> None:
    one = Life("", "night", lambda sentence: None, SimulatedClock(), environment)
    one.ready()
    one.end("complete", "")
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
