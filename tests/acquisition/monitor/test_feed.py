"""What a page gets of a session that grows: all of it first, then only what is new."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from acquisition.monitor.view import SessionWatch, place_of, planned_places, read_session
from experiment.session.journal import Journal
from experiment.session.records import link_steps
from tests.acquisition.monitor.made_up import LIGHTS, MadeUpRun


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


def test_a_page_that_follows_has_in_the_end_what_one_has_that_is_opened_then(run: MadeUpRun) -> None:
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


def test_many_pages_that_follow_at_once_all_get_everything(run: MadeUpRun) -> None:
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


def test_nothing_new_is_nothing_told_and_the_journal_is_not_opened(
    run: MadeUpRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    watch = SessionWatch(run.folder)
    monkeypatch.setattr("acquisition.monitor.view.FRESH_S", 0.0)
    cursor = told(watch)["cursor"]
    assert watch.state(cursor) is None

    def opened(*_: object) -> None:
        raise AssertionError("opened")

    monkeypatch.setattr("acquisition.monitor.view.read_session", opened)
    assert watch.state(cursor) is None


def test_a_preview_that_is_written_after_its_row_is_told(run: MadeUpRun) -> None:
    run.previews = False
    watch = SessionWatch(run.folder)
    attempt = run.take(run.steps[4])
    state = told(watch)
    assert "preview" not in state["frames"][-1]
    (run.folder / "previews" / f"{run.steps[4].stem}.jpg").write_bytes(b"\xff\xd8\xff")
    run.beat("running", "goes on")
    later = told(watch, state["cursor"])
    assert [frame["id"] for frame in later["frames"] if "preview" in frame][-1] == attempt


def test_a_failed_try_has_no_picture_even_if_the_next_bears_its_name(run: MadeUpRun) -> None:
    failed = run.expose(run.steps[4])
    run.journal.fail(failed, run.clock, "no frame came")
    taken = run.take(run.steps[4])
    watch = SessionWatch(run.folder)
    by_id = {frame["id"]: frame for frame in told(watch)["frames"]}
    assert "preview" not in by_id[failed]
    assert "preview" in by_id[taken]
    assert watch.picture(failed) == b""


def test_more_steps_or_another_device_are_told_as_a_whole(run: MadeUpRun) -> None:
    watch = SessionWatch(run.folder)
    state = told(watch)
    added = link_steps(len(run.steps))
    run.journal.add_steps(added)
    more = told(watch, state["cursor"])
    assert [step[0] for step in more["session"]["steps"]] == [step.number for step in (*run.steps, *added)]
    run.journal.record("camera", "another one")
    assert ["camera", "another one"] in told(watch, more["cursor"])["session"]["records"]


def test_an_older_copy_put_back_is_told_as_a_whole(run: MadeUpRun, tmp_path: Path) -> None:
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


def test_another_attempt_of_a_known_number_is_read_again(run: MadeUpRun, tmp_path: Path) -> None:
    """As where an older copy was put back and taken up between two looks."""
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


def test_what_was_seen_is_held_against_the_white_before(run: MadeUpRun) -> None:
    frames = told(SessionWatch(run.folder))["frames"]
    white, light = frames[0], frames[2]
    assert white["seen_at"] == pytest.approx([1 / 3, 1 / 3])
    ratio = [one / of for one, of in zip(light["seen"], white["seen"], strict=True)]
    assert light["seen_at"] == pytest.approx([ratio[0] / sum(ratio), ratio[2] / sum(ratio)], rel=1e-4)


def test_a_refused_white_is_nothing_to_hold_a_light_against(run: MadeUpRun) -> None:
    before = told(SessionWatch(run.folder))["frames"][2]["seen_at"]
    run.journal.void([1], run.clock, "it was no white")
    assert "seen_at" not in told(SessionWatch(run.folder))["frames"][2]
    assert before


def test_places_in_the_plane() -> None:
    assert planned_places([(255, 255, 255), (255, 0, 0), (0, 0, 7), (0, 0, 0)]) == [
        pytest.approx([1 / 3, 1 / 3], rel=1e-5),
        [1, 0],
        [0, 1],
        None,
    ]
    # sRGB, IEC 61966-2-1: code 188 of 255 is half the light of 255.
    assert planned_places([(255, 0, 188)])[0] == pytest.approx([0.6667, 0.3333], abs=0.002)
    assert place_of(float("nan"), 1, 1) is None
    assert place_of(-1, 0.5, 0.2) is None


def test_lights_are_shown_also_without_their_file(run: MadeUpRun) -> None:
    (run.folder / "illuminations.csv").unlink()
    lights = told(SessionWatch(run.folder))["session"]["lights"]
    # What a complete session lacks is said; one that is still taken needs its plan alone.
    assert not read_session(run.folder).unreadable
    assert [light[4:] for light in lights] == [list(light.colour) for light in LIGHTS]
