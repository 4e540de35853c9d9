"""The journal of a run: what is cut off at any byte is taken up again, and another run's is refused."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from evaluation.experiments.run_folder import AnswerJournal, read_journal
from evaluation.metrics import MapError, RegionError
from evaluation.results.result import SceneAnswer
from foundation.errors import InputError

IDENTITY = {"methods": [{"name": "A", "settings": {"p": 1 / 3}}], "software": "x 1", "several lights": (False, True)}
ANSWERS = [
    (SceneAnswer((0.1, 0.2, 1 / 3)), SceneAnswer(None, "returned None")),
    (SceneAnswer((0.6, 0.8, 0.0), "", MapError(1.0, 2.0, float("inf"), (RegionError(1, 0.25, 3.0, 4.0),))),) * 2,
    (SceneAnswer((1.0, 0.0, 0.0)), SceneAnswer((0.0, 1.0, 0.0))),
]


def written(path: Path) -> bytes:
    """Return the bytes of the journal of all answers."""
    assert read_journal(path, IDENTITY) == []
    with path.open("ab", buffering=0) as stream:
        journal = AnswerJournal(stream, 0, path.parent)
        for answers in ANSWERS:
            journal.append(answers)
    return path.read_bytes()


def test_answers_come_back_to_the_last_bit(tmp_path: Path) -> None:
    path = tmp_path / "journal"
    written(path)
    assert read_journal(path, IDENTITY) == ANSWERS


def test_a_journal_cut_anywhere_goes_on_where_it_was_whole(tmp_path: Path) -> None:
    path = tmp_path / "journal"
    whole = written(path)
    ends = [place + 1 for place, byte in enumerate(whole) if byte == ord("\n")]
    for cut in {
        *range(0, len(whole), 41),
        *(end + off for end in ends for off in (-1, 0, 1) if end + off <= len(whole)),
    }:
        path.write_bytes(whole[:cut])
        known = read_journal(path, IDENTITY)
        assert known == ANSWERS[: max(0, sum(end <= cut for end in ends) - 1)]
        with path.open("ab", buffering=0) as stream:
            journal = AnswerJournal(stream, len(known), tmp_path)
            for answers in ANSWERS[len(known) :]:
                journal.append(answers)
        assert path.read_bytes() == whole


@pytest.mark.parametrize("junk", [b"\0" * 50, b"deadbeef {}\n", b"\n"])
def test_what_a_crash_left_behind_is_cut_off(tmp_path: Path, junk: bytes) -> None:
    path = tmp_path / "journal"
    whole = written(path)
    path.write_bytes(whole + junk)
    assert read_journal(path, IDENTITY) == ANSWERS
    assert path.read_bytes() == whole


def test_a_changed_byte_ends_what_is_believed(tmp_path: Path) -> None:
    path = tmp_path / "journal"
    whole = written(path)
    place = whole.index(b"0.6")
    path.write_bytes(whole[:place] + b"0.7" + whole[place + 3 :])
    assert read_journal(path, IDENTITY) == ANSWERS[:1]


def test_another_run_is_refused_and_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "journal"
    whole = written(path)
    other = json.loads(json.dumps(IDENTITY)) | {"software": "x 2", "treatment": {}}
    with pytest.raises(InputError, match="what another run has made so far: its software and treatment differ"):
        read_journal(path, other)
    assert path.read_bytes() == whole


def test_a_run_that_answered_nothing_gives_way(tmp_path: Path) -> None:
    path = tmp_path / "journal"
    assert read_journal(path, IDENTITY) == []
    other = IDENTITY | {"software": "x 2"}
    assert read_journal(path, other) == []
    alone = path.read_bytes()
    path.unlink()
    read_journal(path, other)
    assert path.read_bytes() == alone
