"""Record file of the finished pieces of a long job, so that the job can resume after its program was killed.

A line describes one piece. It has five fields, separated by tabs: SHA-256 of the rest of the line, name of the piece,
hash of its inputs, its file names and their SHA-256 as a JSON object, and its other results as JSON.

- A line is written after the files of its piece.
- Damaged lines, and pieces made from other inputs, are ignored, so these pieces are made again.
- If a file was not flushed to the disk before its line, it is used only if its hash is correct.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import BinaryIO

from foundation.errors import CropError
from foundation.files import sha256_of, stream_sha256


@dataclass(frozen=True)
class Piece:
    """A finished piece of a job."""

    name: str  # Without tabs and line ends
    inputs: str  # Hash or identifier of the inputs
    files: Mapping[str, str]  # SHA-256 by file name
    values: str  # Other results, as JSON on one line

    def to_line(self) -> bytes:
        """Return the line of this piece in a record file."""
        # The first byte is a line end, because the last line of the file may be incomplete.
        rest = "\t".join((self.name, self.inputs, json.dumps(dict(self.files)), self.values)).encode()
        return b"\n%s\t%s\n" % (sha256_of(rest).encode(), rest)

    def is_complete(self, open_file: Callable[[str], AbstractContextManager[BinaryIO]]) -> bool:
        """Return whether all files of this piece exist with the recorded hashes; `open_file` opens a file by name."""
        try:
            for name, sha256 in self.files.items():
                with open_file(name) as stream:
                    if stream_sha256(stream) != sha256:
                        return False
        except (CropError, OSError):
            return False
        return True


def read_pieces(data: bytes, inputs: str | None = None) -> dict[str, Piece]:
    """Return the pieces of a record file by name. If a name occurs several times, the last line is valid.

    If `inputs` is given, only pieces made from these inputs are returned.
    """
    pieces: dict[str, Piece] = {}
    for line in data.split(b"\n"):
        sha256, _, rest = line.partition(b"\t")
        fields = rest.decode("utf-8", "replace").split("\t")
        if sha256 == sha256_of(rest).encode() and len(fields) == 4 and inputs in (None, fields[1]):
            name, piece_inputs, files, values = fields
            pieces[name] = Piece(name, piece_inputs, json.loads(files), values)
    return pieces
