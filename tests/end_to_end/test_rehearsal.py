"""A lab is rehearsed with the shipped programs alone: `sim projector`, `sim camera` before a screen, `acquire`.

Every program that is there at the same time as others is a process of its own, and the commands are those of
docs/how-to/rehearsal.md. The screen is an X server without a monitor, with a window manager on it. Nothing waits for a
time: tests go on when a program has said something.
"""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

from drivers.links.network import TcpLink
from drivers.pjlink import PjLinkProjector
from experiment.session.folder import Session
from tests.drivers.display.x_servers import notification, virtual_screen

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform != "linux", reason="the screen is an X server's"),
]

HOW_TO = (Path(__file__).parents[2] / "docs" / "how-to" / "rehearsal.md").read_text(encoding="utf-8")
SIZE = "320x240"
# For what must come; nothing takes this long unless it fails.
PATIENCE_S = 180.0

PROGRAMS = {"acquire": "acquisition.cli", "build-lut": "calibration.cli", "sim": "synthesis.cli"}


def run_here(command: str, folder: Path) -> None:
    """Run a command of ours to its good end in this process, as one that meets no other program may be run."""
    name, *words = shlex.split(command)
    with contextlib.chdir(folder):
        assert import_module(PROGRAMS[name]).main(words) == 0


@dataclass
class Running:
    """A program under way: what it has said so far, on both its outputs."""

    process: subprocess.Popen[str]
    lines: list[str] = field(default_factory=list)
    said: threading.Condition = field(default_factory=threading.Condition)

    def read(self) -> None:
        assert self.process.stdout is not None
        with self.process.stdout:
            for line in self.process.stdout:
                with self.said:
                    self.lines.append(line)
                    self.said.notify_all()
        with self.said:
            self.lines.append(_END)
            self.said.notify_all()

    def hears(self, words: str) -> str:
        """Return the first line that holds a pattern, when it has come; it must come while the program runs."""
        with self.said:
            assert self.said.wait_for(lambda: self._found(words) or _END in self.lines, PATIENCE_S), self.text
            found = self._found(words)
        assert found, f"{words!r} was never said:\n{self.text}"
        return found

    def ends(self) -> int:
        """Return the exit code."""
        code = self.process.wait(PATIENCE_S)
        with self.said:
            assert self.said.wait_for(lambda: _END in self.lines, PATIENCE_S)
        return code

    @property
    def text(self) -> str:
        return "".join(self.lines)

    def _found(self, words: str) -> str:
        return next((line for line in self.lines if re.search(words, line)), "")


_END = "\0the end"


@dataclass
class Rehearsal:
    """A folder, a screen, and the programs that were started."""

    folder: Path
    replaced: dict[str, str]
    opened: contextlib.ExitStack
    programs: dict[str, Running] = field(default_factory=dict)

    def start(self, command: str) -> Running:
        """Start a command of the how-to; it is ended with the rehearsal."""
        for written, used in self.replaced.items():
            command = command.replace(written, used)
        words = [word for word in shlex.split(command) if word != "&"]
        environment = dict(os.environ) | {"PYTHONUNBUFFERED": "1", "COLUMNS": "400"}
        while "=" in words[0]:
            name, _, value = words.pop(0).partition("=")
            environment[name] = value
        name = words[0]
        if name in PROGRAMS:
            words[:1] = [sys.executable, "-c", f"from {PROGRAMS[name]} import main; raise SystemExit(main())"]
        process = subprocess.Popen(
            words, cwd=self.folder, env=environment, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT, text=True,
        )  # fmt: skip
        running = Running(process)
        reader = threading.Thread(target=running.read, daemon=True)
        reader.start()
        self.opened.callback(reader.join, PATIENCE_S)
        self.opened.callback(_end, process)
        return running

    def run(self, command: str) -> str:
        """Run a command of the how-to to its end, which must be a good one, and return what it said."""
        running = self.start(command)
        code = running.ends()
        assert code == 0, running.text
        return running.text

    def serve(self) -> None:
        """Start projector and camera as the how-to does, in a brighter room, on ports that are free."""
        for name, port, options in (("projector", "4353", ""), ("camera", "15741", QUICK_ROOM)):
            command = next(line for line in commands("sim ") if line.startswith(f"sim {name}"))
            running = self.start(command.replace(f" {port} ", " 0 ").removesuffix("&") + options)
            address = running.hears(r" at 127\.0\.0\.1:\d+").split(":")[-1].strip()
            self.replaced[port] = address
            self.programs[name] = running

    def settings(self, change: Callable[[str], str]) -> None:
        """Write the how-to's LAB.toml with the addresses that there are."""
        (found,) = re.findall(r"^```toml\n(.*?)^```", HOW_TO, re.MULTILINE | re.DOTALL)
        for written, used in self.replaced.items():
            found = found.replace(written, used)
        (self.folder / "LAB.toml").write_text(change(found))

    @property
    def camera(self) -> Running:
        return self.programs["camera"]


def commands(beginning: str = "") -> list[str]:
    """Return the how-to's commands in their order, those that begin with some words."""
    blocks = re.findall(r"^```sh\n(.*?)^```", HOW_TO, re.MULTILINE | re.DOTALL)
    return [line for block in blocks for line in block.splitlines() if line.startswith(beginning)]


def _press_freeze(port: int, frozen: bool) -> None:
    """Freeze the projector's picture, or let it go on, as its remote control would (PJLink class 2, 5.3)."""
    with socket.create_connection(("127.0.0.1", port), timeout=10.0) as line:
        assert line.recv(64) == b"PJLINK 0\r"
        line.sendall(b"%%2FREZ %d\r" % frozen)
        assert line.recv(64) == b"%2FREZ=OK\r"


def _end(process: subprocess.Popen[Any]) -> None:
    process.send_signal(signal.SIGCONT)
    process.terminate()
    process.wait(PATIENCE_S)


@pytest.fixture
def rehearsal(tmp_path: Path) -> Iterator[Rehearsal]:
    """Return a rehearsal of the how-to's chart and lights, on a screen with a window manager."""
    for command in [*commands("acquire chart"), *commands("acquire illuminations")]:
        run_here(command, tmp_path)
    screens = tmp_path / "screen"
    screens.mkdir()
    with contextlib.ExitStack() as opened:
        screen = opened.enter_context(virtual_screen(screens, SIZE))
        rehearsal = Rehearsal(tmp_path, {":77": screen.display}, opened)
        manager = next((name for name in ("openbox", "twm") if shutil.which(name)), None)
        if manager is None:
            pytest.skip("there is no window manager (Debian: openbox, or twm)")
        rehearsal.start(f"DISPLAY=:77 {manager}")
        yield rehearsal


def refusals(session: Path) -> list[str]:
    with Session.open(session) as taken:
        return [attempt.reason for attempt in taken.journal.attempts() if attempt.reason]


# A short exposure.
QUICK = "\n[camera]\nshutter_s = 0.25\n"
# Without the frames that teach the judge the projector: 21 exposures fewer.
UNTAUGHT = "\n[judge]\nresponse = false\n"
# Of the room in which that exposure is a good one.
QUICK_ROOM = " --room white_level_share=1.4"


@pytest.mark.usefixtures("undrawn")
def test_what_the_how_to_says_is_what_happens(rehearsal: Rehearsal, capsys: pytest.CaptureFixture[str]) -> None:
    """Its commands, its pop-up and what it says is worth a try: each is told by its cause, and costs no frame."""
    if shutil.which("xmessage") is None:
        pytest.skip("xmessage is not installed (Debian: x11-utils)")
    rehearsal.serve()
    # One step may meet it all; in between there are lights alone.
    sequence = "attempts = 10\nreference_every = 8"
    rehearsal.settings(lambda text: text.replace("reference_every = 3", sequence) + QUICK + UNTAUGHT)
    port = int(rehearsal.replaced["4353"])
    check, run = commands("DISPLAY=:77 acquire")
    (message,) = commands("DISPLAY=:77 xmessage")
    assert "tags" in rehearsal.run(check)
    session = rehearsal.start(run)

    def after_exposures(count: int) -> None:
        rehearsal.camera.hears(r"exposure \d+ ends: plain picture, .* lamp 1\.00")
        rehearsal.camera.hears(rf"exposure {_last(rehearsal.camera) + count} ends")

    rehearsal.camera.hears(r"exposure \d+ ends: .* lamp 1\.00")
    rehearsal.camera.hears(rf"exposure {_last(rehearsal.camera) + 3} half over")
    pop_up = rehearsal.start(message)
    assert "in front of it lies “xmessage”" in session.hears("refused: .*in front of it lies")
    _end(pop_up.process)
    after_exposures(1)
    projector = PjLinkProjector(lambda: TcpLink.connect("127.0.0.1", port, 10.0), timeout=10.0)
    _press_freeze(port, True)
    session.hears("paused: .*frozen")
    _press_freeze(port, False)
    after_exposures(1)
    projector.set_muted(True)
    session.hears("paused: .*muted")
    projector.set_muted(False)
    projector.close()
    after_exposures(1)
    if shutil.which("xset") is not None:
        rehearsal.run("xset -display :77 s activate")
        session.hears("(paused|retry|refused): .*the screen shows")
        rehearsal.run("xset -display :77 s reset")
        after_exposures(1)
    found = ["in front of it lies “xmessage”", "the screen shows .* look for a window"]
    be_covered_for_half_an_exposure(rehearsal, 1)
    if shutil.which("xcompmgr") is not None:
        rehearsal.start("DISPLAY=:77 xcompmgr")
        # It is there by then: it starts within a frame's time.
        be_covered_for_half_an_exposure(rehearsal, 3)
        found.append("window .*covers")
    after_exposures(1)
    _end(rehearsal.programs["projector"].process)
    session.hears(f"paused: .*nothing listens at 127.0.0.1:{port}")
    again = rehearsal.start(f"sim projector --pjlink {port} --lit")
    again.hears("PJLink projector at")
    assert session.ends() == 0, session.text
    with Session.open(rehearsal.folder / "session") as taken:
        assert len(taken.done_steps()) == len(taken.steps)
        files = {frame.file for frame in taken.frames() if frame.accepted}
    assert len(files) == len(taken.steps)
    reasons = refusals(rehearsal.folder / "session")
    for words in found:
        assert any(re.search(words, reason) for reason in reasons), reasons
    (build,) = commands("build-lut")
    capsys.readouterr()
    run_here(build, rehearsal.folder)
    assert "accept" in capsys.readouterr().out


def be_covered_for_half_an_exposure(rehearsal: Rehearsal, after: int) -> None:
    """Let a window come and go within one of the next exposures.

    It leaves its pixels on a screen that no compositor repairs; where one does, they are in the frame alone.
    """
    covered = _last(rehearsal.camera) + after
    rehearsal.camera.hears(f"exposure {covered} begins")
    with notification(rehearsal.replaced[":77"], (160, 20, 120, 90), 0xFF8800):
        rehearsal.camera.hears(f"exposure {covered} half over")
    assert "not plain" in rehearsal.camera.hears(f"exposure {covered} ends")


def _last(camera: Running) -> int:
    """Return the number of the exposure that began last."""
    return int(re.findall(r"exposure (\d+) begins", camera.text)[-1])


def test_the_how_to_shows_what_the_programs_say() -> None:
    assert "in front of it lies “xmessage”" in HOW_TO
    assert re.search(r"exposure \d+ ends: not plain picture, mean light [\d. ]+, lamp 1\.00", HOW_TO)
