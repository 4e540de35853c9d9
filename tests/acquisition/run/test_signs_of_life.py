"""Signs of life that a run gives, and the last one, which says how it ended."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Callable
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace

import pytest

from acquisition.run import run
from acquisition.run.run import BEGINS, SignOfLife, signs_of_life
from experiment.session.journal import Journal
from foundation.errors import DeviceError, StorageError

NOW = datetime(2026, 1, 1, 23, 30, tzinfo=UTC)


def told(block: Callable[[SignOfLife], None]) -> list[tuple[str, str]]:
    said: list[tuple[str, str]] = []
    signs = signs_of_life(lambda state, sentence, until: said.append((state, sentence)), lambda: None, 60.0)
    with contextlib.suppress(BaseException), signs as alive:
        block(alive)
    return said


def test_a_run_that_comes_to_its_end_gives_no_cause() -> None:
    assert told(lambda alive: alive("")) == [
        ("waiting", BEGINS),
        ("running", "frames are taken"),
        ("ended", ""),
    ]


def test_what_ended_it_is_told() -> None:
    def interrupted(alive: SignOfLife) -> None:
        raise KeyboardInterrupt

    def unplugged(alive: SignOfLife) -> None:
        raise DeviceError("the camera is gone; find it")

    def mistaken(alive: SignOfLife) -> None:
        raise ZeroDivisionError

    assert told(interrupted)[-1] == ("ended", "interrupted; run the same command again")
    assert told(unplugged)[-1] == ("ended", "the camera is gone; find it")
    assert told(mistaken)[-1][0] == "ended"
    assert "mistake of the program" in told(mistaken)[-1][1]


def test_a_frame_a_second_is_no_write_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    seconds = itertools.count()
    clock = SimpleNamespace(monotonic=lambda: float(next(seconds)))
    monkeypatch.setattr(run, "time", clock)

    def twelve_frames(alive: SignOfLife) -> None:
        for _ in range(12):
            alive("")

    assert len(told(twelve_frames)) < 8


def test_after_a_wait_the_first_frame_says_that_it_is_over(tmp_path: Path) -> None:
    Journal.create(tmp_path / "journal.sqlite", ())
    with closing(Journal.open_for_run(tmp_path / "journal.sqlite")) as journal:
        with signs_of_life(journal.beat, journal.run_state, 60.0) as alive:
            journal.beat("waiting", "the lamp warms up", NOW)
            alive("")
            last = journal.heartbeat()
            assert last is not None
            assert last.state == "running"
        last = journal.heartbeat()
        assert last is not None
        assert last.state == "ended"


def test_a_full_disk_does_not_end_the_run() -> None:
    def full(state: str, sentence: str, until: datetime) -> None:
        raise StorageError("no space")

    with signs_of_life(full, lambda: None, 60.0) as alive:
        alive("")
