"""State of a session while it runs, pauses, has ended, or was killed."""

from __future__ import annotations

import json
import re
import shutil
import threading
from collections.abc import Iterator, Sequence
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from acquisition.cli import main
from acquisition.monitor import view
from acquisition.monitor.view import (
    AttemptView,
    Head,
    SessionView,
    SessionWatch,
    head_of,
    planned_chromaticities,
    rb_of,
    read_session,
    with_seconds,
    write_session_report,
)
from experiment.session.heartbeat import Heartbeat, Process, RunState, SessionPlace
from experiment.session.journal import Journal
from experiment.session.records import link_steps, plan_steps
from foundation.errors import StorageError
from tests.acquisition.monitor.made_up import LIGHTS, MadeUpRun

NOW = datetime(2026, 3, 1, 23, 0, tzinfo=UTC)
STEPS = plan_steps(LIGHTS, 25)
HERE = Process.own()
ELSEWHERE = Process(7, "1", "another-machine", "boot")


def attempts(count: int, verdict: str | None = "accepted", seconds: float = 5.0) -> tuple[AttemptView, ...]:
    """Return attempts at the first steps, the newest a moment ago."""
    begun = [NOW - timedelta(seconds=seconds * (count - number)) for number in range(count)]
    views = [
        AttemptView(number + 1, number, "white", None, f"frames/{number}.cr2", at, at, at, verdict, "")
        for number, at in enumerate(begun)
    ]
    return with_seconds(views, [])


def heartbeat(state: RunState, *, ago: float = 2.0, within: float = 10.0, process: Process = HERE) -> Heartbeat:
    at = NOW - timedelta(seconds=ago)
    return Heartbeat(at, process, state, f"{state} as it should", at + timedelta(seconds=within))


def head(
    views: Sequence[AttemptView],
    beat: Heartbeat | None,
    alive: bool | None = True,
    now: datetime = NOW,
    here: SessionPlace | None = None,
) -> Head:
    return head_of(SessionView("night", "night", STEPS, (), {}, tuple(views), (), beat, here), now, alive)


@pytest.mark.parametrize(
    ("ago", "state"), [(0.0, "running"), (49.0, "running"), (51.0, "late"), (329.0, "late"), (331.0, "silent")]
)
def test_hanging_run_is_late_then_silent(ago: float, state: str) -> None:
    """Frames of five seconds: three of them, the five of a sign of life, and thirty; the sign was due within 300 s."""
    beat = heartbeat("running", ago=ago, within=300.0)
    stands = head(attempts(3), beat)
    assert stands.state == state
    assert stands.alive == (state != "silent")
    if state != "running":
        since = "late since" if state == "late" else "no sign of life since"
        assert stands.sentence.startswith(f"{since} {beat.at.astimezone():%Y-%m-%d %H:%M:%S}")
        assert stands.eta is None, "no time of arrival rolls on"


def test_hanging_step_is_late_then_silent() -> None:
    beat = replace(heartbeat("late", within=300.0), sentence="late since 23:00: the camera exposes light 3")
    view = SessionView("night", "night", STEPS, (), {}, attempts(3), (), beat, None)
    stands = head_of(view, NOW, True)
    assert (stands.state, stands.sentence, stands.cause) == ("late", beat.sentence, "the camera")
    after = head_of(view, NOW + timedelta(seconds=329), True)
    assert after.state == "silent"
    assert "last report: late since 23:00: the camera exposes light 3" in after.sentence


@pytest.mark.parametrize(
    ("state", "sentence", "free_mb", "expected"),
    [
        ("running", "frames are taken", 20, ("late", "the disk")),
        ("running", "frames are taken", 30, ("running", "")),
        ("paused", "the projector: it is in standby", 20, ("late", "the disk")),
        ("paused", "the disk: No space left on device", 20, ("paused", "the disk")),
        ("paused", "the frames: light 3: the disk of the sun is seen", 30, ("paused", "the frames")),
        ("ended", "interrupted", 20, ("incomplete", "")),
    ],
)
def test_reports_full_disk(state: RunState, sentence: str, free_mb: float, expected: tuple[str, str]) -> None:
    beat = replace(heartbeat(state), sentence=sentence)
    view = SessionView("night", "night", STEPS, (), {}, attempts(3), (), beat, None, frame_bytes=25_000_000)
    stands = head_of(view, NOW, True, free_bytes=round(free_mb * 1e6))
    assert (stands.state, stands.cause) == expected


@pytest.mark.parametrize("alive", [True, False, None])
def test_recognises_copy_of_session(alive: bool | None) -> None:
    there, here = SessionPlace("/data/night", 5, 10, 11, 0), SessionPlace("/backup/night", 5, 20, 21, 0)
    beat = replace(heartbeat("running"), place=there)
    stands = head(attempts(3), beat, alive, here=here)
    assert (stands.state, stands.alive, stands.eta) == ("copy", False, None)
    assert "/data/night" in stands.sentence
    stands = head(attempts(8), beat, alive, here=here)
    assert stands.state == "complete", "all frames are in the copy, too"
    ended = replace(beat, state="ended")
    assert head(attempts(3), ended, alive, here=here).state == "incomplete"
    where_it_is = head(attempts(3), beat, here=there)
    assert where_it_is.state == "running"


def test_complete_session_names_next_command() -> None:
    for beat, alive in ((heartbeat("ended"), True), (heartbeat("running"), False), (None, None)):
        stands = head(attempts(8), beat, alive=alive)
        assert stands.state == "complete"
        assert stands.sentence == "complete, 8 frames; next: build-lut night LUT/"
    assert head(attempts(8), heartbeat("running")).state == "running"


def test_ignores_negative_intervals() -> None:
    views = [*attempts(4), replace(attempts(1)[0], id=5, step=4, started_at=NOW - timedelta(hours=1))]
    timed = with_seconds([replace(view, seconds=None) for view in views], [])
    assert [one.seconds for one in timed] == [None, 5.0, 5.0, 5.0, None]
    stands = head(timed, heartbeat("running"))
    assert stands.remaining_s == 15.0
    assert stands.eta is None, "the lab's clock is not the wall's"


@pytest.fixture
def run(tmp_path: Path) -> Iterator[MadeUpRun]:
    made = MadeUpRun.begin(tmp_path / "night")
    for step in made.steps[:4]:
        made.take(step)
    yield made
    made.journal.close()


def told(watch: SessionWatch, since: str = "") -> dict[str, Any]:
    state = watch.state(since)
    assert state is not None
    return state


def test_changes_add_up_to_full_state(run: MadeUpRun) -> None:
    watch = SessionWatch(run.folder)
    state = told(watch)
    frames = {frame["id"]: frame for frame in state["frames"]}
    events = list(state["events"])
    sizes: list[int] = []
    cursor = state["cursor"]

    def follow() -> None:
        nonlocal cursor
        news = watch.state(cursor)
        if news is not None:
            cursor = news["cursor"]
            assert "session" not in news
            sizes.append(len(news.get("frames", [])))
            frames.update({frame["id"]: frame for frame in news.get("frames", [])})
            events.extend(news.get("events", []))

    open_attempt = run.expose(run.steps[4])
    follow()
    assert "verdict" not in frames[open_attempt]
    run.journal.fail(open_attempt, run.clock, "the camera is gone; find it")
    follow()
    assert frames[open_attempt]["verdict"] == "failed"
    refused = run.take(run.steps[4], "too bright; close the door")
    follow()
    run.take(run.steps[4])
    run.take(run.steps[5])
    follow()
    run.journal.void([3, 4], run.clock, "the chart has moved")
    follow()
    assert [frames[number]["verdict"] for number in (3, 4)] == ["voided", "voided"]
    assert frames[refused]["reason"] == "too bright; close the door"
    run.take(run.steps[0])
    follow()
    places = {number: frame["seen_at"] for number, frame in frames.items() if "seen_at" in frame}
    run.journal.void([1], run.clock, "it was no white")
    follow()
    assert frames[2]["verdict"] == "accepted"
    assert frames[2]["seen_at"] != places[2]
    run.beat("paused", "the camera: it is gone")
    follow()
    now = told(SessionWatch(run.folder))
    assert [frames[number] for number in sorted(frames)] == now["frames"]
    assert events == now["events"]
    assert min(sizes) < len(now["frames"])


def test_serves_many_pages_completely(run: MadeUpRun) -> None:
    watch = SessionWatch(run.folder)
    over = threading.Event()
    followed: list[set[int]] = []

    def follow() -> None:
        seen: set[int] = set()
        cursor = ""
        last = False
        while True:
            last = over.is_set()
            news = watch.state(cursor)
            if news is not None:
                cursor = news["cursor"]
                seen |= {frame["id"] for frame in news.get("frames", []) if frame.get("verdict") == "accepted"}
            if last:
                break
        followed.append(seen)

    pages = [threading.Thread(target=follow) for _ in range(4)]
    for page in pages:
        page.start()
    for step in run.steps[4:]:
        run.take(step)
    over.set()
    for page in pages:
        page.join()
    assert followed == [set(range(1, len(run.steps) + 1))] * 4


def test_sends_late_preview(run: MadeUpRun) -> None:
    run.previews = False
    watch = SessionWatch(run.folder)
    attempt = run.take(run.steps[4])
    state = told(watch)
    assert "preview" not in state["frames"][-1]
    (run.folder / "previews" / f"{run.steps[4].stem}.jpg").write_bytes(b"\xff\xd8\xff")
    run.beat("running", "goes on")
    later = told(watch, state["cursor"])
    assert [frame["id"] for frame in later["frames"] if "preview" in frame][-1] == attempt


def test_failed_attempt_has_no_picture(run: MadeUpRun) -> None:
    failed = run.expose(run.steps[4])
    run.journal.fail(failed, run.clock, "no frame came")
    taken = run.take(run.steps[4])
    watch = SessionWatch(run.folder)
    by_id = {frame["id"]: frame for frame in told(watch)["frames"]}
    assert "preview" not in by_id[failed]
    assert "preview" in by_id[taken]
    assert watch.picture(failed) == b""


def test_sends_everything_after_changed_plan_or_device(run: MadeUpRun) -> None:
    watch = SessionWatch(run.folder)
    state = told(watch)
    added = link_steps(len(run.steps))
    run.journal.add_steps(added)
    more = told(watch, state["cursor"])
    assert [step[0] for step in more["session"]["steps"]] == [step.number for step in (*run.steps, *added)]
    run.journal.record("camera", "another one")
    assert ["camera", "another one"] in told(watch, more["cursor"])["session"]["records"]


def test_sends_everything_after_restored_copy(run: MadeUpRun, tmp_path: Path) -> None:
    run.journal.close()
    older = tmp_path / "older.sqlite"
    shutil.copy(run.folder / "journal.sqlite", older)
    run.journal = Journal.open_for_run(run.folder / "journal.sqlite")
    run.take(run.steps[4])
    run.journal.close()
    watch = SessionWatch(run.folder)
    state = told(watch)
    assert len(state["frames"]) == 5
    (run.folder / "journal.sqlite").write_bytes(older.read_bytes())
    assert len(told(watch, state["cursor"])["frames"]) == 4


def test_reads_replaced_attempt_again(run: MadeUpRun, tmp_path: Path) -> None:
    """An older copy was restored and resumed between two reads."""
    run.journal.close()
    older = (run.folder / "journal.sqlite").read_bytes()
    run.journal = Journal.open_for_run(run.folder / "journal.sqlite")
    assert run.take(run.steps[4]) == 5
    run.journal.close()
    watch = SessionWatch(run.folder)
    cursor = told(watch)["cursor"]
    (run.folder / "journal.sqlite").write_bytes(older)
    run.journal = Journal.open_for_run(run.folder / "journal.sqlite")
    assert run.take(run.steps[5]) == 5
    assert told(watch, cursor)["frames"][-1]["step"] == 5


def test_relates_colours_to_previous_white(run: MadeUpRun) -> None:
    frames = told(SessionWatch(run.folder))["frames"]
    white, light = frames[0], frames[2]
    assert white["seen_at"] == pytest.approx([1 / 3, 1 / 3])
    ratio = [one / of for one, of in zip(light["seen"], white["seen"], strict=True)]
    assert light["seen_at"] == pytest.approx([ratio[0] / sum(ratio), ratio[2] / sum(ratio)], rel=1e-4)


def test_computes_chromaticities() -> None:
    assert planned_chromaticities([(255, 255, 255), (255, 0, 0), (0, 0, 7), (0, 0, 0)]) == [
        pytest.approx([1 / 3, 1 / 3], rel=1e-5),
        [1, 0],
        [0, 1],
        None,
    ]
    # sRGB, IEC 61966-2-1: code 188 of 255 is half the light of 255.
    assert planned_chromaticities([(255, 0, 188)])[0] == pytest.approx([0.6667, 0.3333], abs=0.002)
    assert rb_of(float("nan"), 1, 1) is None
    assert rb_of(-1, 0.5, 0.2) is None


def test_shows_illuminants_without_their_file(run: MadeUpRun) -> None:
    (run.folder / "illuminations.csv").unlink()
    lights = told(SessionWatch(run.folder))["session"]["lights"]
    # Missing files are reported for a complete session; an active one needs only its plan.
    assert not read_session(run.folder).unreadable
    assert [light[4:] for light in lights] == [list(light.colour) for light in LIGHTS]


SCRIPT = "</script><script>alert(1)</script><!--"


@pytest.fixture
def finished_run(tmp_path: Path) -> Iterator[MadeUpRun]:
    made = MadeUpRun.begin(tmp_path / "night <b>1")
    for step in made.steps[:5]:
        if step.number == 3:
            made.take(step, f"{SCRIPT}; close the door")
        made.take(step)
    yield made
    made.journal.close()


def data_of(path: Path) -> dict[str, Any]:
    """Return what the page of a report holds, found as a browser finds it: up to the first end of a script element."""
    found = re.search(r'<script type="application/json" id="embedded">(.*?)</script', path.read_text(), re.S)
    assert found is not None
    return json.loads(found[1])


def test_report_has_session_and_pictures(finished_run: MadeUpRun, tmp_path: Path) -> None:
    path = tmp_path / "out" / "night.html"
    write_session_report(finished_run.folder, path)
    data = data_of(path)
    assert [frame["verdict"] for frame in data["frames"]].count("accepted") == 5
    assert data["frames"][3]["reason"] == f"{SCRIPT}; close the door"
    assert sorted(data["pictures"], key=int) == ["1", "2", "3", "4", "5", "6"]
    text = path.read_text()
    assert SCRIPT not in text
    assert "night &lt;b&gt;1" in text
    for elsewhere in ('src="http', 'href="http', "@import", "url(http"):
        assert elsewhere not in text


def test_report_treats_own_run_as_ended(finished_run: MadeUpRun) -> None:
    path = write_session_report(finished_run.folder)
    assert path == finished_run.folder / "report.html"
    head = data_of(path)["head"]
    assert head["state"] == "incomplete"
    assert head["sentence"] == "ended, 3 of 8 frames are missing; run the same command again"
    for step in finished_run.steps[5:]:
        finished_run.take(step)
    assert data_of(write_session_report(finished_run.folder))["head"]["state"] == "complete"
    (finished_run.folder / "chart.json").unlink()
    head = data_of(write_session_report(finished_run.folder))["head"]
    assert head["state"] == "incomplete"
    assert "chart.json" in head["sentence"]


def test_report_fails_cleanly_on_full_disk(finished_run: MadeUpRun, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(view, "write_atomic", Mock(side_effect=StorageError("no space")))
    assert main(["report", str(finished_run.folder)]) == StorageError.exit_code
    assert not (finished_run.folder / "report.html").exists()
