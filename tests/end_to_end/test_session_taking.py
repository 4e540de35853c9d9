"""A session is taken, interrupted anywhere, taken up again, replayed and imported; its frames stay the same."""

from __future__ import annotations

import io
import os
import re
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from acquisition.cli import main
from acquisition.run.run import run_session
from drivers.canon.camera import CanonEos
from drivers.pjlink.projector import PjLinkProjector
from drivers.raw.rawfile import read_raw
from experiment.config import load_lab
from experiment.session.folder import Session
from foundation.errors import StorageError

pytestmark = pytest.mark.slow

Hashes = Callable[[Path], dict[tuple[str, str], list[str]]]

KILLER = """
import os, signal, sys
from acquisition.cli import main
import experiment.session.folder, experiment.session.journal, foundation.files

place, count = sys.argv[1], int(sys.argv[2])
owner, name = {
    "renaming": (foundation.files.Path, "replace"),
    "committing": (experiment.session.folder.Session, "commit"),
    "deriving": (experiment.session.folder.Session, "write_frames_csv"),
    "beginning": (experiment.session.journal.Journal, "begin"),
}[place]
real = getattr(owner, name)

def deadly(*args, **kwargs):
    global count
    if "frames" not in str(args[0]) and place == "renaming":
        return real(*args, **kwargs)
    count -= 1
    if count == 0:
        os.kill(os.getpid(), signal.SIGKILL)
    return real(*args, **kwargs)

setattr(owner, name, deadly)
sys.exit(main(sys.argv[3:]))
"""


def run(*arguments: object) -> int:
    return main(list(map(str, arguments)))


def test_a_session_holds_every_frame_of_the_plan(
    lab: Path, frame_hashes: Hashes, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = lab.parent / "session"
    assert run("run", lab, folder) == 0
    hashes = frame_hashes(folder)
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
    assert run("status", folder) == 0
    assert "10 of 10" in capsys.readouterr().out
    assert run("run", lab, folder) == 0, "a complete session is complete again"


@pytest.mark.parametrize(("place", "count"), [("renaming", 1), ("committing", 4), ("deriving", 2), ("beginning", 8)])
def test_a_killed_session_ends_in_the_same_frames(lab: Path, frame_hashes: Hashes, place: str, count: int) -> None:
    undisturbed, killed = lab.parent / "undisturbed", lab.parent / "killed"
    assert run("run", lab, undisturbed) == 0
    done = subprocess.run(
        [sys.executable, "-c", KILLER, place, str(count), "run", str(lab), str(killed)],
        capture_output=True,
        check=False,
    )
    assert done.returncode == -signal.SIGKILL, done.stderr
    assert run("run", lab, killed) == 0
    assert frame_hashes(killed) == frame_hashes(undisturbed)
    assert (killed / "frames.csv").read_text() == (undisturbed / "frames.csv").read_text()
    assert not list(killed.rglob(".*partial*"))


def test_ctrl_c_at_every_frame_ends_in_the_same_frames(lab: Path, frame_hashes: Hashes) -> None:
    undisturbed, interrupted = lab.parent / "undisturbed", lab.parent / "interrupted"
    assert run("run", lab, undisturbed) == 0
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


def test_a_replayed_session_has_the_same_bytes(lab: Path, frame_hashes: Hashes) -> None:
    recorded, replayed = lab.parent / "recorded", lab.parent / "replayed"
    assert run("run", lab, recorded) == 0
    text = lab.read_text().replace('"simulated"', '"replay"')
    lab.write_text(text + '[replay]\nsession = "recorded"\n')
    assert run("run", lab, replayed) == 0
    assert frame_hashes(replayed) == frame_hashes(recorded)


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


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_run_that_is_told_to_end_closes_its_devices(
    lab: Path, number: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    closed: list[str] = []

    def spy(owner: type, name: str) -> None:
        close = owner.close  # pyright: ignore[reportAttributeAccessIssue, reportUnknownMemberType, reportUnknownVariableType]

        def closing(self: object) -> None:
            closed.append(name)
            close(self)

        monkeypatch.setattr(owner, "close", closing)

    spy(CanonEos, "camera")
    spy(PjLinkProjector, "projector")
    spy(Session, "journal")
    commit = Session.commit

    def told_to_end(self: Session, *given: Any, **named: Any) -> None:
        commit(self, *given, **named)
        os.kill(os.getpid(), number)

    session = lab.parent / "session"
    before = signal.getsignal(number)
    with monkeypatch.context() as patched:
        patched.setattr(Session, "commit", told_to_end)
        assert run("run", lab, session) == 130
    assert "interrupted; run the same command again to go on" in capsys.readouterr().err
    assert set(closed) == {"camera", "projector", "journal"}
    assert signal.getsignal(number) == before
    assert run("run", lab, session) == 0


def test_an_imported_session_has_the_same_frames(lab: Path, frame_hashes: Hashes) -> None:
    taken, imported = lab.parent / "taken", lab.parent / "imported"
    assert run("run", lab, taken) == 0
    rows = (taken / "frames.csv").read_text().replace(",accepted", ",")
    (taken / "list.csv").write_text(rows)
    assert run("import", taken / "list.csv", lab.parent / "chart.json", imported) == 0
    assert frame_hashes(imported) == frame_hashes(taken)


def test_an_import_of_a_damaged_file_leaves_nothing(lab: Path, capsys: pytest.CaptureFixture[str]) -> None:
    taken, imported = lab.parent / "taken", lab.parent / "imported"
    assert run("run", lab, taken) == 0
    victim = next((taken / "frames").glob("*light_002*"))
    victim.write_bytes(victim.read_bytes()[:-10])
    assert run("import", taken / "frames.csv", lab.parent / "chart.json", imported) == 2
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
    lab: Path, capsys: pytest.CaptureFixture[str], change: str, expected: str
) -> None:
    folder = lab.parent / "session"
    assert run("run", lab, folder) == 0
    before = (folder / "frames.csv").read_bytes()
    lab.write_text(lab.read_text() + change)
    assert run("run", lab, folder) == 2
    assert expected in capsys.readouterr().err
    assert (folder / "frames.csv").read_bytes() == before


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
    code = f"import sys\nfrom acquisition.cli import main\nsys.exit(main(['run', {str(lab)!r}, {str(folder)!r}]))"
    answers: list[subprocess.CompletedProcess[str]] = []

    def meanwhile(done: int, total: int) -> None:
        if done == 2 and not answers:
            answers.append(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False))

    assert run_session(settings, folder, meanwhile).complete
    assert answers[0].returncode == 2
    assert "another program" in answers[0].stderr


def test_a_journal_that_another_program_holds_is_waited_for_as_long_as_the_settings_say(lab: Path) -> None:
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
        if calls > 20:
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


def test_a_replay_with_another_exposure_is_told_the_recordings(lab: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("run", lab, lab.parent / "recorded") == 0
    text = lab.read_text().replace('"simulated"', '"replay"')
    lab.write_text(text + '[replay]\nsession = "recorded"\n[camera]\nshutter_s = 1.0\n')
    assert run("run", lab, lab.parent / "replayed") == 3
    assert "was taken with 0.5 s" in capsys.readouterr().err


def test_a_series_longer_than_a_battery_lasts(lab: Path) -> None:
    from acquisition.run.rig.opening import open_rig
    from drivers.camera import capture
    from experiment.chart.model import load_chart

    settings = load_lab(lab)
    with open_rig(settings, load_chart(settings.chart)) as devices:
        devices.camera.configure(settings.camera.exposure)
        frames = {capture(devices.camera, io.BytesIO()).name for _ in range(430)}
    assert len(frames) == 430


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
