"""What was answered so far of a run that goes on: a file that grows by one line an image, and is taken up after a kill.

Each line is a checksum (CRC-32 of what follows, eight hexadecimal digits), the image's number, and its answers as JSON.
The first line says whose answers they are. A line that a kill or a crash left half, and all after it, are cut off.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

from evaluation.results.answers import SceneAnswer, answer_from_json, answer_to_json
from foundation.errors import InputError
from foundation.files import storage_error

JOURNAL_FILE = "answers.jsonl"
"""Its name in the hidden folder of a run."""


def read_journal(path: Path, identity: dict[str, Any]) -> list[tuple[SceneAnswer, ...]]:
    """Return the answers of the first images, and cut off what is not whole; begin the file where there is none."""
    try:
        content = path.read_bytes() if path.exists() else b""
        whole, lines = _whole_lines(content)
        head: dict[str, Any] = json.loads(lines[0]) if lines else {}
        same = head == json.loads(json.dumps(identity))
        if not same and len(lines) <= 1:
            # Nothing was answered, so nothing is lost: a method that failed on the first image was corrected, say.
            path.write_bytes(_line(identity))
            return []
        if not same:
            raise InputError(
                f"{path.parent} holds what another run has made so far: its {_difference(head, identity)} differ; go "
                "on with that run by its own options, name another place, or remove that folder to begin anew"
            )
        answers: list[tuple[SceneAnswer, ...]] = []
        kept = len(_line(identity))
        for line in lines[1:]:
            stored = json.loads(line)
            if stored["image"] != len(answers):
                break
            answers.append(tuple(map(answer_from_json, stored["answers"])))
            kept += len(line) + _OVERHEAD
        kept = min(kept, whole)
        if kept < len(content):
            with path.open("r+b") as stream:
                stream.truncate(kept)
    except OSError as error:
        raise storage_error(path, error) from error
    return answers


class AnswerJournal:
    """The file, open to be continued."""

    def __init__(self, stream: BinaryIO, count: int, folder: Path) -> None:
        self._stream = stream
        self._count = count
        self._folder = folder

    def append(self, answers: Sequence[SceneAnswer]) -> None:
        """Add the answers for the next image."""
        line = _line({"image": self._count, "answers": [answer_to_json(answer) for answer in answers]})
        try:
            self._stream.write(line)
        except OSError as error:
            raise storage_error(self._folder, error) from error
        self._count += 1


_OVERHEAD = len("00000000 \n")
"""Bytes of a line beside its JSON: checksum, space, end."""


def _line(content: dict[str, Any]) -> bytes:
    text = json.dumps(content, separators=(",", ":")).encode()
    return b"%08x %s\n" % (zlib.crc32(text), text)


def _whole_lines(content: bytes) -> tuple[int, list[bytes]]:
    """Return the length of the lines that are whole, and their JSON."""
    lines: list[bytes] = []
    place = 0
    while (end := content.find(b"\n", place)) >= 0:
        check, _, text = content[place:end].partition(b" ")
        if check != b"%08x" % zlib.crc32(text):
            break
        lines.append(text)
        place = end + 1
    return place, lines


def _difference(there: dict[str, Any], here: dict[str, Any]) -> str:
    """Return the parts in which two identities differ."""
    return " and ".join(name for name in {**there, **here} if there.get(name) != json.loads(json.dumps(here.get(name))))
