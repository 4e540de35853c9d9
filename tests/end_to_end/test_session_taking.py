"""A session is taken, interrupted anywhere, taken up again and imported; its frames stay the same."""

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

FORKS = multiprocessing.get_context("forkserver")
"""Programs beside this one, without waiting for their imports each time."""
FORKS.set_forkserver_preload([__name__, "acquisition.run.run", "acquisition.run.run", "sim.camera.eos"])


def run_to_pipe(answer: Connection, *arguments: str) -> None:
    """Run `acquire` and send its exit code and what it says on stderr."""
    said = io.StringIO()
    with contextlib.redirect_stderr(said):
        code = main(arguments)
    answer.send((code, said.getvalue()))


def run(*arguments: object) -> int:
    return main(list(map(str, arguments)))


def test_a_session_holds_every_frame_of_the_plan(
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
    assert len(set(everything)) == len(everything), "two frames have the same noise"
    capsys.readouterr()
    assert run("status", session) == 0
    assert "10 of 10" in capsys.readouterr().out
    assert run("run", lab, session) == 0, "a complete session is complete again"


def test_ctrl_c_at_every_frame_ends_in_the_same_frames(lab: Path, undisturbed: Path, frame_hashes: Hashes) -> None:
    interrupted = lab.parent / "interrupted"
    settings = load_lab(lab)
    for _ in range(50):
        last: list[int] = []

        def interrupt(done: int, total: int, last: list[int] = last) -> None:
            last.append(done)
            if len(last) == 3:
                raise KeyboardInterrupt

        try:
            if run_session(settings, interrupted, interrupt).complete:
                break
        except KeyboardInterrupt:
            continue
    assert frame_hashes(interrupted) == frame_hashes(undisturbed)


@pytest.mark.parametrize(
    ("text", "said"), [(None, "No such file"), ("garbage", "has no illuminants, expected columns")]
)
def test_a_look_reads_the_lights_too(
    lab: Path, text: str | None, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    lights = lab.parent / "illuminations.csv"
    lights.unlink()
    if text is not None:
        lights.write_text(text)
    assert run("check", lab) == 2
    told = capsys.readouterr().err
    assert str(lights) in told
    assert said in told


@pytest.mark.usefixtures("hang_up")
def test_a_run_that_is_told_to_end_closes_its_devices(
    lab: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
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

    def told_to_end(self: Journal, *given: Any, **named: Any) -> None:
        commit(self, *given, **named)
        os.kill(os.getpid(), signal.SIGTERM)

    session = lab.parent / "session"
    before = signal.getsignal(signal.SIGTERM)
    with monkeypatch.context() as patched:
        patched.setattr(Journal, "commit", told_to_end)
        assert run("run", lab, session) == 130
    assert "interrupted; run the same command again" in capsys.readouterr().err
    assert set(closed) == {"camera", "projector", "journal"}
    assert signal.getsignal(signal.SIGTERM) == before
    assert run("run", lab, session) == 0


def test_an_imported_session_has_the_same_frames(lab: Path, session: Path, frame_hashes: Hashes) -> None:
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
def test_a_session_is_not_continued_with_other_settings(
    lab: Path, session: Path, capsys: pytest.CaptureFixture[str], change: str, expected: str
) -> None:
    before = (session / "frames.csv").read_bytes()
    lab.write_text(lab.read_text() + change)
    assert run("run", lab, session) == 2
    assert expected in capsys.readouterr().err
    assert (session / "frames.csv").read_bytes() == before


def test_a_foreign_folder_is_left_alone(lab: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = lab.parent / "thesis"
    folder.mkdir()
    (folder / "chapter1.tex").write_text("all my work")
    assert run("run", lab, folder) == 2
    assert "already exists" in capsys.readouterr().err
    assert [path.name for path in folder.iterdir()] == ["chapter1.tex"]


def test_overexposed_frames_are_refused_and_said(lab: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lab.write_text(lab.read_text() + "[camera]\nshutter_s = 2.0\n")
    folder = lab.parent / "session"
    assert run("run", lab, folder) == 4
    message = capsys.readouterr().err
    assert "clipped" in message
    assert "0.1 % allowed" in message
    with Session.open(folder) as session:
        refused = [frame for frame in session.frames() if not frame.accepted]
        assert refused
        assert all((folder / frame.file).is_file() for frame in refused), "a refused frame is evidence and is kept"


def test_two_programs_do_not_take_the_same_session(lab: Path) -> None:
    settings = load_lab(lab)
    folder = lab.parent / "session"
    ours, theirs = FORKS.Pipe()

    def meanwhile(done: int, total: int) -> None:
        if done == 2 and not ours.poll():
            program = FORKS.Process(target=run_to_pipe, args=(theirs, "run", str(lab), str(folder)))
            program.start()
            program.join()

    assert run_session(settings, folder, meanwhile).complete
    code, said = ours.recv()
    assert code == 2
    assert "another program" in said


def test_a_journal_that_another_program_holds_is_waited_for_as_long_as_the_settings_say(
    lab: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("experiment.session.opening.TRY_S", 0.01)
    lab.write_text(lab.read_text().replace("[sequence]", "[sequence]\npatience_s = 0"))
    folder = lab.parent / "session"
    others: list[sqlite3.Connection] = []

    def hold(done: int, total: int) -> None:
        if done == 2 and not others:
            others.append(sqlite3.connect(folder / "journal.sqlite", isolation_level=None))
            others[0].execute("BEGIN IMMEDIATE")

    with pytest.raises(StorageError):
        run_session(load_lab(lab), folder, hold)
    others[0].close()
    assert run_session(load_lab(lab), folder, lambda done, total: None).complete


def test_a_series_longer_than_a_battery_lasts(lab: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = load_lab(lab)
    few = {name: replace(body, shots_per_charge=4) for name, body in EOS_BODIES.items()}
    monkeypatch.setattr("acquisition.run.rig.simulated.EOS_BODIES", few)
    with open_rig(settings, load_chart(settings.chart)) as devices:
        devices.camera.configure(settings.camera.exposure)
        frames = {capture(devices.camera, io.BytesIO()).name for _ in range(9)}
    assert len(frames) == 9


def test_following_what_a_check_recommends_leads_to_a_good_exposure(
    lab: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = lab.read_text() + "[camera]\nshutter_s = "
    lab.write_text(f"{text}1.3\n")
    assert run("check", lab) == 4
    (said,) = re.findall(r"set camera\.shutter_s = (\S+) \(measured: [\d.]+ %\)", capsys.readouterr().out)
    assert abs(float(said) * 60 - round(float(said) * 60)) < 0.01, "whole turns of a wheel of 60 Hz"
    lab.write_text(f"{text}{said}\n")
    assert run("check", lab) == 0
    assert "good        brightest_share" in capsys.readouterr().out
