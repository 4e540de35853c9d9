"""A session is taken, interrupted anywhere, taken up again, replayed and imported; its frames stay the same."""

from __future__ import annotations

import contextlib
import io
import itertools
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
from drivers.raw.rawfile import read_raw
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

PLACES = {
    "renaming": (Path, "replace"),
    "committing": (Journal, "commit"),
}


def run_until_killed(place: str, count: int, *arguments: str) -> None:
    """Run `acquire`; the process is killed before the `count`-th call at a place."""
    owner, name = PLACES[place]
    real, left = getattr(owner, name), itertools.count(count, -1)

    def deadly(*given: Any, **named: Any) -> Any:
        if (place != "renaming" or "frames" in str(given[0])) and next(left) == 1:
            os.kill(os.getpid(), signal.SIGKILL)
        return real(*given, **named)

    setattr(owner, name, deadly)
    main(arguments)


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


@pytest.mark.parametrize(("place", "count"), [("renaming", 1), ("committing", 4)])
def test_a_killed_session_ends_in_the_same_frames(
    lab: Path, undisturbed: Path, frame_hashes: Hashes, place: str, count: int
) -> None:
    killed = lab.parent / "killed"
    program = FORKS.Process(target=run_until_killed, args=(place, count, "run", str(lab), str(killed)))
    program.start()
    program.join()
    assert program.exitcode == -signal.SIGKILL
    assert run("run", lab, killed) == 0
    assert frame_hashes(killed) == frame_hashes(undisturbed)
    assert (killed / "frames.csv").read_text() == (undisturbed / "frames.csv").read_text()
    assert not list(killed.rglob(".*partial*"))


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


def test_a_replayed_session_has_the_same_bytes(lab: Path, session: Path, frame_hashes: Hashes) -> None:
    replayed = lab.parent / "replayed"
    text = lab.read_text().replace('"simulated"', '"replay"')
    lab.write_text(text + '[replay]\nsession = "session"\n')
    assert run("run", lab, replayed) == 0
    assert frame_hashes(replayed) == frame_hashes(session)


@pytest.mark.parametrize(("text", "said"), [(None, "No such file"), ("garbage", "expected lights under the columns")])
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
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_run_that_is_told_to_end_closes_its_devices(
    lab: Path, number: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
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
        os.kill(os.getpid(), number)

    session = lab.parent / "session"
    before = signal.getsignal(number)
    with monkeypatch.context() as patched:
        patched.setattr(Journal, "commit", told_to_end)
        assert run("run", lab, session) == 130
    assert "interrupted; run the same command again to go on" in capsys.readouterr().err
    assert set(closed) == {"camera", "projector", "journal"}
    assert signal.getsignal(number) == before
    assert run("run", lab, session) == 0


def test_an_imported_session_has_the_same_frames(lab: Path, session: Path, frame_hashes: Hashes) -> None:
    imported = lab.parent / "imported"
    rows = (session / "frames.csv").read_text().replace(",accepted", ",")
    (session / "list.csv").write_text(rows)
    assert run("import", session / "list.csv", lab.parent / "chart.json", imported) == 0
    assert frame_hashes(imported) == frame_hashes(session)


def test_an_import_of_a_damaged_file_leaves_nothing(
    lab: Path, session: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    imported = lab.parent / "imported"
    victim = next((session / "frames").glob("*light_002*"))
    victim.write_bytes(victim.read_bytes()[:-10])
    assert run("import", session / "frames.csv", lab.parent / "chart.json", imported) == 2
    assert victim.name in capsys.readouterr().err
    assert not imported.exists()


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

    with pytest.raises(StorageError, match="end the other program that holds the session"):
        run_session(load_lab(lab), folder, hold)
    others[0].close()
    assert run_session(load_lab(lab), folder, lambda done, total: None).complete


def test_a_full_disk_costs_nothing_taken(
    lab: Path, monkeypatch: pytest.MonkeyPatch, frame_hashes: Hashes, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = lab.parent / "session"
    real: Callable[[int], None] = os.fsync
    calls = 0

    def fail(handle: int) -> None:
        nonlocal calls
        calls += 1
        if calls > 40:
            raise OSError(28, "No space left on device")
        real(handle)

    monkeypatch.setattr(os, "fsync", fail)
    assert run("run", lab, folder) == 5
    assert "No space left on device" in capsys.readouterr().err
    monkeypatch.setattr(os, "fsync", real)
    # The list of frames is derived, and could not be written on a full disk.
    Session.open_for_run(folder).close()
    kept = frame_hashes(folder)
    assert kept
    assert run("run", lab, folder) == 0
    after: dict[Any, list[str]] = frame_hashes(folder)
    assert all(set(files) <= set(after[key]) for key, files in kept.items())


def test_a_replay_with_another_exposure_is_told_the_recordings(
    lab: Path, session: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = lab.read_text().replace('"simulated"', '"replay"')
    lab.write_text(text + '[replay]\nsession = "session"\n[camera]\nshutter_s = 1.0\n')
    assert run("run", lab, lab.parent / "replayed") == 3
    assert "was taken with 0.5 s" in capsys.readouterr().err


def test_a_series_longer_than_a_battery_lasts(lab: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = load_lab(lab)
    few = {name: replace(body, shots_per_charge=4) for name, body in EOS_BODIES.items()}
    monkeypatch.setattr("acquisition.run.rig.simulated.EOS_BODIES", few)
    with open_rig(settings, load_chart(settings.chart)) as devices:
        devices.camera.configure(settings.camera.exposure)
        frames = {capture(devices.camera, io.BytesIO()).name for _ in range(9)}
    assert len(frames) == 9


@pytest.mark.parametrize(("shutter_s", "code"), [(0.02, 0), (1.3, 4)])
def test_following_what_a_check_recommends_leads_to_a_good_exposure(
    lab: Path, shutter_s: float, code: int, capsys: pytest.CaptureFixture[str]
) -> None:
    text = lab.read_text() + "[camera]\nshutter_s = "
    lab.write_text(f"{text}{shutter_s}\n")
    # A table is made of dim frames, with remarks; of clipped ones it is not.
    assert run("check", lab) == code
    (said,) = re.findall(r"set camera\.shutter_s = (\S+) \(tried: \d+ %\)", capsys.readouterr().out)
    assert abs(float(said) * 60 - round(float(said) * 60)) < 0.01, "whole turns of a wheel of 60 Hz"
    lab.write_text(f"{text}{said}\n")
    assert run("check", lab) == 0
    assert "good        exposure" in capsys.readouterr().out


def test_what_is_recommended_holds_whole_turns_of_the_simulated_room_s_wheel(
    lab: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    room = "[simulated.room]\nwheel_hz = 50\nwhite_level_share = 9\nshutter_jitter_s = 0\n"
    lab.write_text(f"{lab.read_text()}{room}[camera]\nshutter_s = 0.1\n")
    assert run("check", lab) == 4
    assert "set camera.shutter_s = 0.04 (tried: 7" in capsys.readouterr().out


def test_what_goes_wrong_stands_in_lab_toml_and_may_change(lab: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, text = lab.parent / "session", lab.read_text()
    strip = '{ what = "zeroed strip", from_frame = 3, to_frame = 3 }'
    lab.write_text(text.replace("seed = 7\n", f"seed = 7\nevents = [{strip}]\n"))
    run("run", lab, folder)
    torn: set[str] = set()
    for path in sorted((folder / "frames").glob("*.dng")):
        rows = read_raw(path).sensor
        if not rows[len(rows) // 2 + 5].any():
            torn.add(path.stem)
    with Session.open(folder) as session:
        assert torn == {session.steps[3].stem}
    lab.write_text(text)
    capsys.readouterr()
    assert run("run", lab, folder) == 0, "the trouble is over, and the session goes on"
