"""Passwords and secret addresses are in no file of a session or LUT, and not on the terminal."""

from __future__ import annotations

import json
import socket
from importlib import import_module
from pathlib import Path

import pytest

from acquisition.monitor.serving import open_monitor
from acquisition.run.run import run_session
from experiment.config import load_lab
from tests.end_to_end.conftest import make_lab
from tests.found_texts import files_with

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("undrawn")]

PASSWORD = "pj-5ecret-word"
TOKEN = "ntfy-t0ken-path"

LAB = """
rig = "simulated"
chart = "chart.json"
illuminations = "illuminations.csv"
[judge]
response = false
[sequence]
notify = "{notify}"
[simulated]
body = "Test"
seed = 11
[lab.projector]
control = "pjlink"
host = "192.0.2.7"
password = "{password}"
"""


def command(module: str, *arguments: object) -> int:
    return int(import_module(module).main([*map(str, arguments)]))


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    """Return a LAB.toml with a password and a webhook that does not answer."""
    with socket.socket() as free_socket:
        free_socket.bind(("127.0.0.1", 0))
        port = free_socket.getsockname()[1]
    folder = tmp_path / "private"
    folder.mkdir()
    path = make_lab(folder)
    path.write_text(LAB.format(notify=f"http://u:{PASSWORD}@127.0.0.1:{port}/{TOKEN}?auth={TOKEN}", password=PASSWORD))
    return path


def test_writes_no_secret_to_session_or_lut(lab: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    public = tmp_path / "public"
    public.mkdir()
    session = public / "session"
    messages: list[str] = []
    files_by_frame: list[list[str]] = []

    def look(count: int, total: int) -> None:
        # During the run its journal has a write-ahead log.
        files_by_frame.append(files_with(public, PASSWORD, TOKEN))

    settings = load_lab(lab)
    assert run_session(settings, session, look, messages.append, state=messages.append).complete
    assert any("http://127.0.0.1" in sentence and "did not receive" in sentence for sentence in messages)
    assert command("acquisition.cli", "status", session) == 0
    assert command("acquisition.cli", "status", session, "--json") == 0
    assert command("acquisition.cli", "report", session) == 0
    assert command("acquisition.cli", "run", lab, session, "--dry-run") == 0
    assert command("calibration.cli", session, public / "lut") in (0, 4)
    with open_monitor(session, 0) as server:
        page = server.page[0] + json.dumps(server.watch.state(""), default=str)
    files_by_frame.append(files_with(public, PASSWORD, TOKEN))
    assert len(files_by_frame) > 6
    assert not any(files_by_frame)
    output = "".join(capsys.readouterr()) + "".join(messages) + page
    assert PASSWORD not in output
    assert TOKEN not in output
