"""Frames on which threads work before their turn come back in order, and wait for one another where they must."""

from __future__ import annotations

import threading
from datetime import UTC, datetime
from pathlib import Path

import pytest

from calibration.pipeline import build as prefetching
from calibration.pipeline.build import build, prefetched
from calibration.verdict import BuildResult
from experiment.session.folder import Session
from experiment.session.records import FrameRecord
from tests.calibration.lab import figures_alone

pytestmark = pytest.mark.slow

AT = datetime(2024, 3, 1, tzinfo=UTC)


def records(kinds: str) -> list[FrameRecord]:
    kind = {"w": "white", "d": "dark", "l": "light"}
    return [
        FrameRecord(kind[letter], None, f"{number}.dng", "", AT, 0.5, "accepted")  # pyrefly: ignore[bad-argument-type]
        for number, letter in enumerate(kinds)
    ]


@pytest.fixture(params=[1, 2, 5])
def threads(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> int:
    monkeypatch.setattr(prefetching, "thread_count", lambda: request.param)
    return request.param


def test_frames_come_back_in_order(threads: int) -> None:
    todo = records("l" * 40)
    results = prefetched(lambda record: record.file, todo, lambda _: False)
    assert [(record.file, result) for record, result in results] == [(record.file, record.file) for record in todo]


def test_what_follows_a_frame_that_others_wait_for_begins_after_it_is_taken_in(threads: int) -> None:
    todo, begun, lock = records("wdlldllldll"), list[str](), threading.Lock()

    def work(record: FrameRecord) -> None:
        with lock:
            begun.append(record.file)

    taken: list[str] = []
    for record, _ in prefetched(work, todo, lambda record: record.kind == "dark"):
        if record.kind == "dark":
            last = max(int(name.removesuffix(".dng")) for name in begun)
            assert last == int(record.file.removesuffix(".dng"))
        taken.append(record.file)
    assert taken == [record.file for record in todo]


def test_a_fault_comes_in_its_turn(threads: int) -> None:
    def work(record: FrameRecord) -> str:
        if record.file == "3.dng":
            raise ValueError(record.file)
        return record.file

    taken: list[str] = []
    with pytest.raises(ValueError, match=r"3\.dng"):
        taken.extend(result for _, result in prefetched(work, records("lllllll"), lambda _: False))
    assert taken == ["0.dng", "1.dng", "2.dng"]


def test_the_same_session_gives_the_same_table_by_any_number_of_threads(
    session: Session, built: BuildResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert built.lut is not None
    other = 1 if prefetching.thread_count() > 1 else 4
    monkeypatch.setattr(prefetching, "thread_count", lambda: other)
    build(session, tmp_path / "again", report=figures_alone)
    for path in sorted(built.lut.iterdir()):
        # The one report has no page, and so the sums do not list it.
        if path.name not in ("report.html", "SHA256SUMS", "report.json"):
            assert (tmp_path / "again" / path.name).read_bytes() == path.read_bytes(), path.name
