"""A session is taken, interrupted, resumed and imported; its frames stay the same."""

from __future__ import annotations

import contextlib
import io
import multiprocessing
import os
import re
import signal
import sqlite3
from collections.abc import Callable
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import pytest

from acquisition.cli import main
from acquisition.run.rig.opening import open_rig
from acquisition.run.run import run_session
from drivers.camera import capture
from drivers.canon import CanonEos
from drivers.pjlink import PjLinkProjector
from experiment.chart.model import load_chart
from experiment.config import load_lab
from experiment.session.folder import Session
from experiment.session.journal import Journal
from foundation.errors import StorageError
from sim.camera.bodies import EOS_BODIES

pytestmark = pytest.mark.slow

Hashes = Callable[[Path], dict[tuple[str, str], list[str]]]

# Parallel programs that need not import everything again.
FORKS = multiprocessing.get_context("forkserver")
FORKS.set_forkserver_preload([__name__, "acquisition.run.run", "acquisition.run.run", "sim.camera.eos"])


def run_to_pipe(connection: Connection, *arguments: str) -> None:
    """Run `acquire` and send its exit code and its stderr."""
    stderr = io.StringIO()
    with contextlib.redirect_stderr(stderr):
        code = main(arguments)
    connection.send((code, stderr.getvalue()))


def run(*arguments: object) -> int:
    return main(list(map(str, arguments)))


def test_session_has_every_planned_frame(
    lab: Path, session: Path, frame_hashes: Hashes, capsys: pytest.CaptureFixture[str]
) -> None:
    hashes = frame_hashes(session)
    assert {key: len(files) for key, files in hashes.items()} == {
        ("light", "0"): 1,
        ("light", "1"): 1,
        ("light", "2"): 1,
        ("light", "3"): 1,
        ("white", ""): 3,
        ("dark", ""): 3,
    }
    everything = [digest for files in hashes.values() for digest in files]
    assert len(set(everything)) == len(everything), "two frames must not have the same noise"
    capsys.readouterr()
    assert run("status", session) == 0
    assert "10 of 10" in capsys.readouterr().out
    assert run("run", lab, session) == 0, "running a complete session again succeeds"


def test_ctrl_c_at_every_frame_keeps_frames(lab: Path, undisturbed: Path, frame_hashes: Hashes) -> None:
    interrupted = lab.parent / "interrupted"
    settings = load_lab(lab)
    for _ in range(50):
        last: list[int] = []

        def interrupt(count: int, total: int, last: list[int] = last) -> None:
            last.append(count)
            if len(last) == 3:
                raise KeyboardInterrupt

        try:
            if run_session(settings, interrupted, interrupt).complete:
                break
        except KeyboardInterrupt:
            continue
    assert frame_hashes(interrupted) == frame_hashes(undisturbed)


@pytest.mark.parametrize(
    ("text", "expected"), [(None, "No such file"), ("garbage", "has no illuminants, expected columns")]
)
def test_check_reads_illuminants(
    lab: Path, text: str | None, expected: str, capsys: pytest.CaptureFixture[str]
) -> None:
    lights = lab.parent / "illuminations.csv"
    lights.unlink()
    if text is not None:
        lights.write_text(text)
    assert run("check", lab) == 2
    message = capsys.readouterr().err
    assert str(lights) in message
    assert expected in message


@pytest.mark.usefixtures("hang_up")
def test_sigterm_closes_devices(lab: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    closed: list[str] = []

    def spy(owner: type, name: str) -> None:
        close = owner.close

        def closing(self: object) -> None:
            closed.append(name)
            close(self)

        monkeypatch.setattr(owner, "close", closing)

    spy(CanonEos, "camera")
    spy(PjLinkProjector, "projector")
    spy(Session, "journal")
    commit = Journal.commit

    def commit_and_terminate(self: Journal, *arguments: Any, **options: Any) -> None:
        commit(self, *arguments, **options)
        os.kill(os.getpid(), signal.SIGTERM)

    session = lab.parent / "session"
    handler = signal.getsignal(signal.SIGTERM)
    with monkeypatch.context() as patched:
        patched.setattr(Journal, "commit", commit_and_terminate)
        assert run("run", lab, session) == 130
    assert "interrupted; run the same command again" in capsys.readouterr().err
    assert set(closed) == {"camera", "projector", "journal"}
    assert signal.getsignal(signal.SIGTERM) == handler
    assert run("run", lab, session) == 0


def test_imported_session_has_same_frames(lab: Path, session: Path, frame_hashes: Hashes) -> None:
    imported = lab.parent / "imported"
    rows = (session / "frames.csv").read_text().replace(",accepted", ",")
    (session / "list.csv").write_text(rows)
    assert run("import", session / "list.csv", lab.parent / "chart.json", imported) == 0
    assert frame_hashes(imported) == frame_hashes(session)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ("[camera]\nshutter_s = 1.0\n", "'shutter_s': 0.5"),
        ("[simulated.room]\nblur_px = 0.9\n", "simulated"),
    ],
)
def test_refuses_to_resume_with_other_settings(
    lab: Path, session: Path, capsys: pytest.CaptureFixture[str], change: str, expected: str
) -> None:
    rows = (session / "frames.csv").read_bytes()
    lab.write_text(lab.read_text() + change)
    assert run("run", lab, session) == 2
    assert expected in capsys.readouterr().err
    assert (session / "frames.csv").read_bytes() == rows


def test_does_not_touch_foreign_folder(lab: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = lab.parent / "thesis"
    folder.mkdir()
    (folder / "chapter1.tex").write_text("all my work")
    assert run("run", lab, folder) == 2
    assert "already exists" in capsys.readouterr().err
    assert [path.name for path in folder.iterdir()] == ["chapter1.tex"]


def test_rejects_overexposed_frames(lab: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lab.write_text(lab.read_text() + "[camera]\nshutter_s = 2.0\n")
    folder = lab.parent / "session"
    assert run("run", lab, folder) == 4
    message = capsys.readouterr().err
    assert "clipped" in message
    assert "0.1 % allowed" in message
    with Session.open(folder) as session:
        rejected = [frame for frame in session.frames() if not frame.accepted]
        assert rejected
        assert all((folder / frame.file).is_file() for frame in rejected), "rejected frames are kept"


def test_refuses_second_program_on_session(lab: Path) -> None:
    settings = load_lab(lab)
    folder = lab.parent / "session"
    ours, theirs = FORKS.Pipe()

    def meanwhile(count: int, total: int) -> None:
        if count == 2 and not ours.poll():
            program = FORKS.Process(target=run_to_pipe, args=(theirs, "run", str(lab), str(folder)))
            program.start()
            program.join()

    assert run_session(settings, folder, meanwhile).complete
    code, message = ours.recv()
    assert code == 2
    assert "another program" in message


def test_waits_for_locked_journal_up_to_patience(lab: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("experiment.session.opening.TRY_S", 0.01)
    lab.write_text(lab.read_text().replace("[sequence]", "[sequence]\npatience_s = 0"))
    folder = lab.parent / "session"
    connections: list[sqlite3.Connection] = []

    def hold(count: int, total: int) -> None:
        if count == 2 and not connections:
            connections.append(sqlite3.connect(folder / "journal.sqlite", isolation_level=None))
            connections[0].execute("BEGIN IMMEDIATE")

    with pytest.raises(StorageError):
        run_session(load_lab(lab), folder, hold)
    connections[0].close()
    assert run_session(load_lab(lab), folder, lambda count, total: None).complete


def test_takes_series_longer_than_battery(lab: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = load_lab(lab)
    few = {name: replace(body, shots_per_charge=4) for name, body in EOS_BODIES.items()}
    monkeypatch.setattr("sim.camera.bodies.EOS_BODIES", few)
    with open_rig(settings, load_chart(settings.chart)) as devices:
        devices.camera.configure(settings.camera.exposure)
        frames = {capture(devices.camera, io.BytesIO()).name for _ in range(9)}
    assert len(frames) == 9


def test_recommended_exposure_is_good(lab: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = lab.read_text() + "[camera]\nshutter_s = "
    lab.write_text(f"{text}1.3\n")
    assert run("check", lab) == 4
    (shutter_s,) = re.findall(r"set camera\.shutter_s = (\S+) \(measured: [\d.]+ %\)", capsys.readouterr().out)
    assert abs(float(shutter_s) * 60 - round(float(shutter_s) * 60)) < 0.01, "whole turns of a wheel of 60 Hz"
    lab.write_text(f"{text}{shutter_s}\n")
    assert run("check", lab) == 0
    assert "good        brightest_share" in capsys.readouterr().out
