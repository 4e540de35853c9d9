"""Rehearse a laboratory with the shipped programs alone: `sim projector`, `sim camera` in front of a screen, `acquire`.

Programs that run at the same time are separate processes; the commands are those of docs/how-to/rehearsal.md. The
screen is an X server without a monitor, with a window manager. Tests wait for output of the programs, not for times.
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
# Time limit for expected output; reached only by a failing test.
PATIENCE_S = 180.0

PROGRAMS = {"acquire": "acquisition.cli", "build-lut": "calibration.cli", "sim": "synthesis.cli"}


def run_here(command: str, folder: Path) -> None:
    """Run one of our commands in this process, which is possible if it meets no other program."""
    name, *words = shlex.split(command)
    with contextlib.chdir(folder):
        assert import_module(PROGRAMS[name]).main(words) == 0


@dataclass
class Running:
    """A running program with its output so far."""

    process: subprocess.Popen[str]
    lines: list[str] = field(default_factory=list)
    condition: threading.Condition = field(default_factory=threading.Condition)

    def read(self) -> None:
        assert self.process.stdout is not None
        with self.process.stdout:
            for line in self.process.stdout:
                with self.condition:
                    self.lines.append(line)
                    self.condition.notify_all()
        with self.condition:
            self.lines.append(_END_OF_OUTPUT)
            self.condition.notify_all()

    def wait_for_line(self, pattern: str) -> str:
        """Return the first line that matches; it must come while the program runs."""
        with self.condition:
            assert self.condition.wait_for(
                lambda: self._matching_line(pattern) or _END_OF_OUTPUT in self.lines, PATIENCE_S
            ), self.text
            line = self._matching_line(pattern)
        assert line, f"{pattern!r} is missing in the output:\n{self.text}"
        return line

    def wait_for_end(self) -> int:
        """Return the exit code."""
        code = self.process.wait(PATIENCE_S)
        with self.condition:
            assert self.condition.wait_for(lambda: _END_OF_OUTPUT in self.lines, PATIENCE_S)
        return code

    @property
    def text(self) -> str:
        return "".join(self.lines)

    def _matching_line(self, pattern: str) -> str:
        return next((line for line in self.lines if re.search(pattern, line)), "")


_END_OF_OUTPUT = "\0the end"


@dataclass
class Rehearsal:
    """A folder, a screen, and the started programs."""

    folder: Path
    replaced: dict[str, str]
    opened: contextlib.ExitStack
    programs: dict[str, Running] = field(default_factory=dict)

    def start(self, command: str) -> Running:
        """Start a command of the how-to; it ends with the rehearsal."""
        for page_text, replacement in self.replaced.items():
            command = command.replace(page_text, replacement)
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
        """Run a command of the how-to to its end and return its output."""
        running = self.start(command)
        code = running.wait_for_end()
        assert code == 0, running.text
        return running.text

    def serve(self) -> None:
        """Start projector and camera as in the how-to, in a brighter room, on free ports."""
        for name, port, options in (("projector", "4353", ""), ("camera", "15741", QUICK_ROOM)):
            command = next(line for line in commands("sim ") if line.startswith(f"sim {name}"))
            running = self.start(command.replace(f" {port} ", " 0 ").removesuffix("&") + options)
            address = running.wait_for_line(r" at 127\.0\.0\.1:\d+").split(":")[-1].strip()
            self.replaced[port] = address
            self.programs[name] = running

    def settings(self, change: Callable[[str], str]) -> None:
        """Write the LAB.toml of the how-to with the present addresses."""
        (text,) = re.findall(r"^```toml\n(.*?)^```", HOW_TO, re.MULTILINE | re.DOTALL)
        for page_text, replacement in self.replaced.items():
            text = text.replace(page_text, replacement)
        (self.folder / "LAB.toml").write_text(change(text))

    @property
    def camera(self) -> Running:
        return self.programs["camera"]


def commands(beginning: str = "") -> list[str]:
    """Return the commands of the how-to that start with `beginning`, in order."""
    blocks = re.findall(r"^```sh\n(.*?)^```", HOW_TO, re.MULTILINE | re.DOTALL)
    return [line for block in blocks for line in block.splitlines() if line.startswith(beginning)]


def _press_freeze(port: int, frozen: bool) -> None:
    """Freeze or release the projected image, as with the remote control (PJLink class 2, 5.3)."""
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
    """Return a rehearsal with the chart and illuminants of the how-to, on a screen with a window manager."""
    for command in [*commands("acquire chart"), *commands("acquire illuminations")]:
        run_here(command, tmp_path)
    screens = tmp_path / "screen"
    screens.mkdir()
    with contextlib.ExitStack() as opened:
        screen = opened.enter_context(virtual_screen(screens, SIZE))
        rehearsal = Rehearsal(tmp_path, {":77": screen.display}, opened)
        manager = next((name for name in ("openbox", "twm") if shutil.which(name)), None)
        if manager is None:
            pytest.skip("no window manager is installed (Debian: openbox or twm)")
        rehearsal.start(f"DISPLAY=:77 {manager}")
        yield rehearsal


def refusals(session: Path) -> list[str]:
    with Session.open(session) as taken:
        return [attempt.reason for attempt in taken.journal.attempts() if attempt.reason]


# A short exposure.
QUICK = "\n[camera]\nshutter_s = 0.25\n"
# Without the response frames: 21 exposures fewer.
NO_RESPONSE = "\n[judge]\nresponse = false\n"
# Option of a room that suits this exposure.
QUICK_ROOM = " --room white_level_share=1.4"


@pytest.mark.usefixtures("undrawn")
def test_faults_of_how_to_are_reported(rehearsal: Rehearsal, capsys: pytest.CaptureFixture[str]) -> None:
    """Each fault of the how-to is reported with its cause, and no frame is lost."""
    if shutil.which("xmessage") is None:
        pytest.skip("xmessage is not installed (Debian: x11-utils)")
    rehearsal.serve()
    # One step may meet all faults; in between there are only illuminants.
    sequence = "attempts = 10\nreference_every = 8"
    rehearsal.settings(lambda text: text.replace("reference_every = 3", sequence) + QUICK + NO_RESPONSE)
    port = int(rehearsal.replaced["4353"])
    check, run = commands("DISPLAY=:77 acquire")
    (message,) = commands("DISPLAY=:77 xmessage")
    assert "tags" in rehearsal.run(check)
    session = rehearsal.start(run)

    def after_exposures(count: int) -> None:
        rehearsal.camera.wait_for_line(r"exposure \d+ ends: plain picture, .* lamp 1\.00")
        rehearsal.camera.wait_for_line(rf"exposure {_last(rehearsal.camera) + count} ends")

    rehearsal.camera.wait_for_line(r"exposure \d+ ends: .* lamp 1\.00")
    rehearsal.camera.wait_for_line(rf"exposure {_last(rehearsal.camera) + 3} half over")
    pop_up = rehearsal.start(message)
    assert "“xmessage”" in session.wait_for_line("refused: .* covers it")
    _end(pop_up.process)
    after_exposures(1)
    projector = PjLinkProjector(lambda: TcpLink.connect("127.0.0.1", port, 10.0), timeout=10.0)
    _press_freeze(port, True)
    session.wait_for_line("paused: .*frozen")
    _press_freeze(port, False)
    after_exposures(1)
    projector.set_muted(True)
    session.wait_for_line("paused: .*muted")
    projector.set_muted(False)
    projector.close()
    after_exposures(1)
    if shutil.which("xset") is not None:
        rehearsal.run("xset -display :77 s activate")
        session.wait_for_line("(paused|retry|refused): .*the screen shows")
        rehearsal.run("xset -display :77 s reset")
        after_exposures(1)
    patterns = ["“xmessage”.* covers it", "the screen shows .*check for a window"]
    cover_half_exposure(rehearsal, 1)
    if shutil.which("xcompmgr") is not None:
        rehearsal.start("DISPLAY=:77 xcompmgr")
        # The compositor starts within one frame.
        cover_half_exposure(rehearsal, 3)
        patterns.append("window .*covers")
    after_exposures(1)
    _end(rehearsal.programs["projector"].process)
    session.wait_for_line(f"paused: .*nothing listens at 127.0.0.1:{port}")
    restarted = rehearsal.start(f"sim projector --pjlink {port} --lit")
    restarted.wait_for_line("PJLink projector at")
    assert session.wait_for_end() == 0, session.text
    with Session.open(rehearsal.folder / "session") as result:
        assert len(result.done_steps()) == len(result.steps)
        files = {frame.file for frame in result.frames() if frame.accepted}
    assert len(files) == len(result.steps)
    reasons = refusals(rehearsal.folder / "session")
    for words in patterns:
        assert any(re.search(words, reason) for reason in reasons), reasons
    (build,) = commands("build-lut")
    capsys.readouterr()
    run_here(build, rehearsal.folder)
    assert "accept" in capsys.readouterr().out


def cover_half_exposure(rehearsal: Rehearsal, offset: int) -> None:
    """Cover the screen with a window during half of one of the next exposures.

    Without a compositor its pixels stay on the screen; with one, they are only in the frame.
    """
    exposure = _last(rehearsal.camera) + offset
    rehearsal.camera.wait_for_line(f"exposure {exposure} starts")
    with notification(rehearsal.replaced[":77"], (160, 20, 120, 90), 0xFF8800):
        rehearsal.camera.wait_for_line(f"exposure {exposure} half over")
    assert "not plain" in rehearsal.camera.wait_for_line(f"exposure {exposure} ends")


def _last(camera: Running) -> int:
    """Return the number of the exposure that started last."""
    return int(re.findall(r"exposure (\d+) starts", camera.text)[-1])


def test_how_to_shows_output_of_programs() -> None:
    assert "“xmessage”, 181×77 px at +230+160 covers it" in " ".join(HOW_TO.split())
    assert re.search(r"exposure \d+ ends: not plain picture, mean light [\d. ]+, lamp 1\.00", HOW_TO)
