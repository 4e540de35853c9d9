"""Finished pieces of long work: the record from which a program that was killed goes on.

A record file has one line for each finished piece: the SHA-256 of the rest of the line, then the piece's name, the
hash of its inputs, its files as a JSON object of names and SHA-256, and its values as JSON, separated by tabs.

- A line is written after the files of its piece.
- A line that was cut or changed is left out, and so is a piece of other inputs: that piece is made again.
- A file that was not synchronised with the disk before its line was written counts only if it has its hash.
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
    """A finished piece.

    - `name`: what it is; without tabs and line ends.
    - `inputs`: hash, or identifier, of all that it was made of.
    - `files`: SHA-256 of each file that it consists of, by the file's name.
    - `values`: all else that it gave, JSON on one line.
    """

    name: str
    inputs: str
    files: Mapping[str, str]
    values: str

    def to_line(self) -> bytes:
        """Return its line of a record file; it may follow a line that was cut."""
        rest = "\t".join((self.name, self.inputs, json.dumps(dict(self.files)), self.values)).encode()
        return b"\n%s\t%s\n" % (sha256_of(rest).encode(), rest)

    def is_complete(self, open_file: Callable[[str], AbstractContextManager[BinaryIO]]) -> bool:
        """Return whether each of its files is there with its hash; `open_file` opens one by its name."""
        try:
            for name, sha256 in self.files.items():
                with open_file(name) as stream:
                    if stream_sha256(stream) != sha256:
                        return False
        except (CropError, OSError):
            return False
        return True


def read_pieces(data: bytes, inputs: str | None = None) -> dict[str, Piece]:
    """Return the pieces in a record file's bytes by their names, the last of each name; damaged lines are left out.

    `inputs`: what the pieces must be made of; None for any.
    """
    found: dict[str, Piece] = {}
    for line in data.split(b"\n"):
        sha256, _, rest = line.partition(b"\t")
        fields = rest.decode("utf-8", "replace").split("\t")
        if sha256 == sha256_of(rest).encode() and len(fields) == 4 and inputs in (None, fields[1]):
            name, made_of, files, values = fields
            found[name] = Piece(name, made_of, json.loads(files), values)
    return found
