"""`SHA256SUMS` of a table: the hash of each of its files, held against them, and the one hash that names them all.

The file has the form of `sha256sum`, so that ``sha256sum -c SHA256SUMS`` checks a table without this software, and
``sha256sum SHA256SUMS`` gives the table's hash: whoever was told it from elsewhere has every byte of the table by it.

Small files are looked at whenever a table is opened, samples when a light is first used. Tables made before the file
was written have hashes of ground truth and samples in `lut.json`, or none at all; what they have is held against them.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final

from calibration.table.file_names import (
    FRAMES,
    ILLUMINATIONS,
    PROVENANCE,
    REFERENCES,
    REPORT_JSON,
    REPORT_PAGE,
    SAMPLES,
    SUMS,
)
from calibration.table.provenance import Provenance
from foundation.errors import FormatError
from foundation.foreign_folders import require_plain_folder
from foundation.hashing import file_sha256

MOST_BYTES: Final = {
    PROVENANCE: 64 << 20,
    ILLUMINATIONS: 16 << 20,
    FRAMES: 16 << 20,
    REFERENCES: 64 << 20,
    REPORT_JSON: 64 << 20,
    REPORT_PAGE: 256 << 20,
    SUMS: 64 << 10,
}
"""Largest sizes of a table's files but its samples: forty times those of 707 lights and 32 768 colours."""

OPTIONAL: Final = frozenset({REPORT_PAGE})
"""Files that a table may do without: no number is read from them, and a table that was fetched has none."""

_LINE = re.compile(r"([0-9a-f]{64})  ([A-Za-z0-9_][A-Za-z0-9_.-]{0,99})")

_TEXTS: Final = (ILLUMINATIONS, FRAMES, REFERENCES, REPORT_JSON, REPORT_PAGE)

RESTORE: Final = "restore it from a copy, fetch the table again, or build it anew"


def sums_of(folder: Path, samples_sha256: str, provenance: str) -> str:
    """Return the text of `SHA256SUMS` of a table that is complete but for `lut.json`."""
    hashes = {name: file_sha256(folder / name) for name in _TEXTS if (folder / name).is_file()}
    hashes |= {SAMPLES: samples_sha256, PROVENANCE: provenance}
    return "".join(f"{hashes[name]}  {name}\n" for name in sorted(hashes))


def parse_sums(text: str, path: Path) -> dict[str, str]:
    """Return the hashes of a table's files by name."""
    hashes: dict[str, str] = {}
    for number, line in enumerate(text.splitlines(), 1):
        found = _LINE.fullmatch(line)
        if found is None or found[2] in hashes:
            raise FormatError(f"{path}, line {number}: expected a hash, two blanks and a name of its own; {RESTORE}")
        hashes[found[2]] = found[1]
    lacking = {PROVENANCE, ILLUMINATIONS, SAMPLES} - hashes.keys()
    if lacking:
        raise FormatError(f"{path} does not list {' and '.join(sorted(lacking))}; {RESTORE}")
    return hashes


def require_plain_table(folder: Path) -> None:
    """Refuse a table's folder with files that are no files, or larger than they may be; a FormatError says which."""
    require_plain_folder(folder, MOST_BYTES)


def known_sums(folder: Path, provenance: Provenance) -> dict[str, str]:
    """Return the recorded hashes of a table's files by name, `samples.npy` included; of older tables what they have."""
    if provenance.has_sums:
        path = folder / SUMS
        try:
            return parse_sums(path.read_text("utf-8"), path)
        except (OSError, UnicodeDecodeError) as error:
            reason = error.strerror if isinstance(error, OSError) else "it is no text"
            raise FormatError(f"cannot read {path}: {reason}; {RESTORE}") from error
    if (folder / SUMS).exists():
        raise FormatError(
            f"{folder / PROVENANCE} does not know of {SUMS} beside it: one of them has changed; {RESTORE}"
        )
    recorded = {ILLUMINATIONS: provenance.illuminations_sha256, SAMPLES: provenance.samples_sha256}
    return dict(provenance.files_sha256) | {name: known for name, known in recorded.items() if known is not None}


def changed_files(folder: Path, known: Mapping[str, str]) -> Iterator[str]:
    """Yield, in words, each file of a table but its samples that is not as it was built, is gone, or is not listed."""
    for name, then in known.items():
        path = folder / name
        if name == SAMPLES or (name in OPTIONAL and not path.exists()):
            continue
        if not path.is_file():
            yield f"{name} is gone"
        elif file_sha256(path) != then:
            yield f"{name} is not as it was built" + ": lights or ground truth have changed" * (name == ILLUMINATIONS)
    if PROVENANCE in known:
        # Nothing but what is listed is read, so that only files of a table's own names matter.
        yield from (
            f"{name} is no part of the table as it was built"
            for name in _TEXTS
            if name not in known and (folder / name).exists()
        )


def require_listed(folder: Path, provenance: Provenance, lights: int) -> dict[str, str]:
    """Return the recorded hashes of a table's files after holding all but the samples against them."""
    hashes = len(provenance.lights_sha256)
    if hashes not in (lights, 0) or (provenance.has_sums and not hashes):
        raise FormatError(
            f"{folder / PROVENANCE} has hashes of {hashes} lights, the table has {lights} lights; {RESTORE}"
        )
    known = known_sums(folder, provenance)
    for fault in changed_files(folder, known):
        raise FormatError(f"{folder}: {fault}; {RESTORE}")
    return known
