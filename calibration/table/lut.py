"""The look-up table on disk: what lies in it (docs/formats.md), and how it is opened for reading.

The generator reads tables through this file, and nothing behind it; `calibration.table.writing` writes them. Every
released version of the format stays readable. `SHA256SUMS` has the form of `sha256sum`, so that a table is checked
without this software, and its own hash names the table. Small files are held against their hashes whenever a table is
opened, samples when a light is first used.
"""

from __future__ import annotations

import csv
import hashlib
import io
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from calibration.citation import OriginRecord
from experiment.lights import Illumination, load_illuminations
from foundation.errors import FormatError, InputError, value_text
from foundation.files import file_sha256, partial_path, read_text, reading_error, require_plain_folder, sha256_of
from foundation.records import Record, from_json

FORMAT: Final = "crop.lut"

VERSION: Final = 1  # The only version so far

Sha256 = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]  # A SHA-256 as 64 lowercase hexadecimal digits

# Name of a file that lies in the table's own folder.
FileName = Annotated[str, Field(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}$")]

FRAME_FIELDS: Final = ("kind", "illumination", "file", "sha256")  # Columns of a table's `frames.csv` (docs/formats.md)

MOST_SAMPLES: Final = 1024  # Samples of a cell at most: the largest window has 9×9

# What the table was made from and how; written last, so that a folder without it is no table.
PROVENANCE: Final = "lut.json"

SAMPLES: Final = "samples.npy"  # The samples, uint16 little-endian, C order, [light, colour, sample, RGB]

ILLUMINATIONS: Final = "illuminations.csv"  # The lights and their ground truth

FRAMES: Final = "frames.csv"  # The raw files that the table was made from; absent in computed tables

REFERENCES: Final = "references.csv"  # The grey references under each light, where the chart has some

# The expanded uncertainty of each light's ground truth, and its causes; absent in computed tables.
UNCERTAINTY: Final = "uncertainty.csv"

CELLS: Final = "cells.csv"  # The expanded relative uncertainty of each cell's mean; absent in computed tables

REPORT_PAGE: Final = "report.html"  # The report for people

REPORT_JSON: Final = "report.json"  # The report for programs

SUMS: Final = "SHA256SUMS"  # Hashes of all other files of the table, as `sha256sum -c` reads them

REPORT_FORMAT: Final = "crop.report"

REPORT_VERSION: Final = 1  # `format` and `version` of `report.json` (docs/formats.md)

# Largest sizes of a table's files but its samples: forty times those of 707 lights and 32 768 colours.
MOST_BYTES: Final = {
    PROVENANCE: 64 << 20,
    ILLUMINATIONS: 16 << 20,
    FRAMES: 16 << 20,
    REFERENCES: 64 << 20,
    UNCERTAINTY: 16 << 20,
    CELLS: 16 << 20,
    REPORT_JSON: 64 << 20,
    REPORT_PAGE: 256 << 20,
    SUMS: 64 << 10,
}

# Files that a table may do without: no number is read from them, and a table that was fetched has none.
OPTIONAL: Final = frozenset({REPORT_PAGE})

_LINE = re.compile(r"([0-9a-f]{64})  ([A-Za-z0-9_][A-Za-z0-9_.-]{0,99})")
_TEXTS: Final = (ILLUMINATIONS, FRAMES, REFERENCES, UNCERTAINTY, CELLS, REPORT_JSON, REPORT_PAGE)
RESTORE: Final = "restore it from a copy, fetch the table again, or build it anew"

# Columns of `illuminations.csv` with the ground truth, after those of the lights.
WHITE_COLUMNS: Final = ("white_r", "white_g", "white_b")

EXPANDED: Final = "expanded_deg"  # Column of `uncertainty.csv` with a light's expanded uncertainty

CELL_COLUMNS: Final = ("expanded_r", "expanded_g", "expanded_b")  # Columns of `cells.csv` after the colour's index

# A ground truth is below this, in units of samples of 16 bits: what is larger was not measured, and its chromaticity
# might not be a number.
MOST_WHITE: Final = 1_000_000


class Unfit(BaseModel):
    """A cell whose samples must not be used, and why."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    colour: int = Field(ge=0)
    cause: str

    @property
    def kind(self) -> str:
        """The cause in a word, without its numbers."""
        return self.cause.split(":")[0]


class Provenance(Record):
    """The content of `lut.json`.

    - `camera`: maker and model as the raw files name it.
    - `bits`: bits kept of each channel; the table has 8**bits colours.
    - `white_level`: sample value of sensor saturation: linear camera RGB after black subtraction.
    - `corrections`: what was applied to the counts, with its parameters, in order.
    - `session_sha256`: hash over the frames' hashes (`calibration.table.lut.frames_sha256`).
    - `chart_sha256`: hash of the chart.
    - `samples_sha256`, `illuminations_sha256`: of the files; None until the table is written.
    - `lights_sha256`: of each light's samples as they lie in the file, in the order of lights, so that damage can be
      traced to a light.
    - `files_sha256`: of further files of the table, `references.csv`.
    - `has_sums`: whether `SHA256SUMS` lists every file of the table; false until it is written.
    - `computed`: where the table was computed from spectra and a model of the sensor and nothing was photographed: by
      what, and with which settings. None where it was made from frames.
    - `origin`: with what, when and by whom the frames were taken, and under which licence the table may be used; None
      in computed tables of which nothing is stated.
    """

    format: Literal["crop.lut"] = FORMAT
    version: Literal[1] = VERSION
    camera: str
    bits: int = Field(ge=1, le=5)
    white_level: int = Field(ge=1, le=65535)
    corrections: list[dict[str, Any]] = Field(default_factory=list[dict[str, Any]])
    session_sha256: str
    chart_sha256: str
    software: str
    unfit: list[Unfit] = Field(default_factory=list[Unfit])
    samples_sha256: Sha256 | None = None
    illuminations_sha256: Sha256 | None = None
    lights_sha256: list[Sha256] = Field(default_factory=list[Sha256])
    files_sha256: dict[FileName, Sha256] = Field(default_factory=dict[FileName, Sha256])
    has_sums: bool = False
    computed: dict[str, Any] | None = None
    origin: OriginRecord | None = None

    @model_validator(mode="after")
    def _require_colours(self) -> Self:
        beyond = [cell.colour for cell in self.unfit if cell.colour >= 8**self.bits]
        if beyond:
            raise ValueError(f"unfit: colour {beyond[0]} is none of the {8**self.bits} of {self.bits} bits a channel")
        return self

    def to_json(self) -> str:
        """Return the text of `lut.json`; `computed` and `origin` stand in it where they are known."""
        left_out = {name for name in ("computed", "origin") if getattr(self, name) is None}
        return self.model_dump_json(indent=2, exclude=left_out) + "\n"


class _Head(BaseModel):
    format: Any = None
    version: Any = None


def parse_provenance(text: bytes, path: Path) -> Provenance:
    """Return the content of `lut.json` from its bytes."""
    try:
        head = _Head.model_validate_json(text)
    except ValidationError as error:
        raise FormatError(f"{path} is no table's description: it is damaged; build the table again") from error
    if head.format != FORMAT:
        raise FormatError(f"{path} is no table of CroP: its format is not {FORMAT!r}; name a folder made by build-lut")
    if head.version != VERSION:
        raise FormatError(
            f"{path.parent} is a table of version {head.version!r}, this software reads version {VERSION}; "
            "build it again from its session with build-lut, or install the software that wrote it"
        )
    found = from_json(Provenance, text, path, "restore it from a copy")
    if not found.has_sums:
        raise FormatError(f"{path} does not know of {SUMS} beside it; {RESTORE}")
    return found


@dataclass(frozen=True)
class SourceFrame:
    """A raw file that a table was made from.

    - `kind`: ``light``, ``white`` or ``dark``.
    - `illumination`: number of the light; None for white and dark frames.
    - `file`: path relative to the session's folder.
    - `sha256`: of the file.
    """

    kind: str
    illumination: int | None
    file: str
    sha256: str


def frames_sha256(frames: Sequence[SourceFrame]) -> str:
    """Return the hash that names a session: SHA-256 over kind, light and hash of each frame used, a line each."""
    lines = [f"{frame.kind},{frame.illumination},{frame.sha256}\n" for frame in frames]
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def load_frames(path: Path) -> tuple[SourceFrame, ...]:
    """Return the frames that a `frames.csv` lists, in the order taken; none where the file does not exist."""
    if not path.is_file():
        return ()
    try:
        rows = list(csv.DictReader(io.StringIO(path.read_text(encoding="utf-8"))))
        return tuple(
            SourceFrame(
                row["kind"], int(row["illumination"]) if row["illumination"] else None, row["file"], row["sha256"]
            )
            for row in rows
        )
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise FormatError(
            f"{path} is damaged: columns {','.join(FRAME_FIELDS)} expected; build the table again"
        ) from error


def light_sha256(samples: npt.NDArray[np.uint16]) -> str:
    """Return the SHA-256 of one light's samples (8**bits, S, 3) uint16, as their bytes lie in the file."""
    return sha256_of(np.ascontiguousarray(samples, dtype="<u2").data)


def map_samples(path: Path, lights: int, bits: int) -> npt.NDArray[np.uint16]:
    """Return `samples.npy` (lights, 8**bits, samples, 3) uint16, mapped from the disk."""
    try:
        with path.open("rb") as stream:
            version = np.lib.format.read_magic(stream)
            if version != (1, 0):
                raise ValueError(f"it is of version {version[0]}.{version[1]}, 1.0 expected")
            shape, columns_first, dtype = np.lib.format.read_array_header_1_0(stream)
            offset, size = stream.tell(), stream.seek(0, 2)
    except OSError as error:
        raise reading_error(path, error, "build the table again") from error
    except Exception as error:
        # The head is a Python literal, which fails in many ways.
        raise FormatError(f"cannot read {path}: {error}; restore it from a copy, or build the table again") from error
    plain = dtype == np.dtype("<u2") and not columns_first and len(shape) == 4
    if not plain or shape[:2] != (lights, 8**bits) or not 0 < shape[2] <= MOST_SAMPLES or shape[3] != 3:
        raise FormatError(
            f"{path} holds {dtype} {shape}, expected uint16 ({lights}, {8**bits}, samples, 3) of 1 to {MOST_SAMPLES} "
            "samples; build the table again"
        )
    expected = offset + math.prod(shape) * 2
    if size != expected:
        raise FormatError(f"{path} has {size} bytes, {expected} expected; restore it from a copy, or build it again")
    return np.memmap(path, dtype, "r", offset, shape)


def samples_sha256(
    path: Path, samples: npt.NDArray[np.uint16], progress: Callable[[int, int], None] | None = None
) -> tuple[str, list[str]]:
    """Return the hash of the file, and of each light's part of it, read once and in order.

    `samples`: (L, 8**bits, S, 3) uint16, the same file mapped: its shape is used.
    """
    whole, lights = hashlib.sha256(), list[str]()
    size = samples[0].nbytes
    try:
        with path.open("rb") as stream:
            whole.update(stream.read(path.stat().st_size - len(samples) * size))
            for light in range(len(samples)):
                slab = stream.read(size)
                whole.update(slab)
                lights.append(sha256_of(slab))
                if progress is not None:
                    progress(light + 1, len(samples))
    except OSError as error:
        raise FormatError(f"cannot read {path}: {error.strerror}; check the disk, or build the table again") from error
    return whole.hexdigest(), lights


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


def known_sums(folder: Path) -> dict[str, str]:
    """Return the recorded hashes of a table's files by name, `samples.npy` included."""
    return parse_sums(read_text(folder / SUMS, RESTORE), folder / SUMS)


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
    # Nothing but what is listed is read, so that only files of a table's own names matter.
    yield from (
        f"{name} is no part of the table as it was built"
        for name in _TEXTS
        if name not in known and (folder / name).exists()
    )


def require_listed(folder: Path, provenance: Provenance, lights: int) -> dict[str, str]:
    """Return the recorded hashes of a table's files after holding all but the samples against them."""
    hashes = len(provenance.lights_sha256)
    if hashes != lights:
        raise FormatError(
            f"{folder / PROVENANCE} has hashes of {hashes} lights, the table has {lights} lights; {RESTORE}"
        )
    known = known_sums(folder)
    for fault in changed_files(folder, known):
        raise FormatError(f"{folder}: {fault}; {RESTORE}")
    return known


@dataclass(frozen=True, eq=False)
class Lut:
    """A table, its samples mapped from disk and read only where they are used.

    Attributes
    ----------
    folder
        Where it lies.
    samples
        (L, 8**bits, S, 3) uint16, linear camera RGB, `provenance.white_level` = saturation.
    illuminations
        The L lights.
    white
        (L, 3) float64, linear camera RGB of the achromatic reference in the units of the samples: the ground truth.
    provenance
        The content of `lut.json`.
    """

    folder: Path
    samples: npt.NDArray[np.uint16]
    illuminations: tuple[Illumination, ...]
    white: npt.NDArray[np.float64]
    provenance: Provenance

    def __repr__(self) -> str:
        """Return one line: provenance alone would be some hundred kilobytes."""
        lights, colours, samples, _ = self.samples.shape
        told = f"{lights} lights, {colours} colours of {samples} samples"
        return f"Lut({str(self.folder)!r}, {self.provenance.camera}, {told})"

    @cached_property
    def ground_truth(self) -> npt.NDArray[np.float64]:
        """(L, 3) float64, the lights' chromaticities, r + g + b = 1."""
        return self.white / self.white.sum(axis=1, keepdims=True)

    @cached_property
    def sha256(self) -> str:
        """SHA-256 that names the table, as a dataset records it: of `SHA256SUMS`, which has the hash of every file."""
        return file_sha256(self.folder / SUMS)

    def require_unchanged(self, light: int) -> None:
        """Raise unless a light's samples are those that were measured; costs the reading of a light, once for each.

        Raises
        ------
        FormatError
            They are not.
        """
        if light in self._unchanged:
            return
        if light_sha256(self.samples[light]) != self.provenance.lights_sha256[light]:
            raise FormatError(
                f"{self.folder / SAMPLES}: the samples of light {light} are not those that were measured; see what "
                f"else has changed with build-lut verify {self.folder}, then copy the table again or build it anew"
            )
        self._unchanged.add(light)

    def light_samples(self, light: int) -> npt.NDArray[np.uint16]:
        """Return the samples (8**bits, S, 3) uint16 of a light, as they are on the disk, after `require_unchanged`.

        Raises
        ------
        FormatError
            They are not those that were measured.
        """
        self.require_unchanged(light)
        return self.samples[light]

    @cached_property
    def _unchanged(self) -> set[int]:
        return set()

    @cached_property
    def truth_uncertainty_deg(self) -> npt.NDArray[np.float64] | None:
        """(L,) float64 degrees, expanded uncertainty (k = 2) of the ground truth; None in computed tables.

        Raises
        ------
        FormatError
            `uncertainty.csv` is damaged.
        """
        path = self.folder / UNCERTAINTY
        return _load_uncertainty(path, len(self.illuminations)) if path.is_file() else None

    @cached_property
    def frames(self) -> tuple[SourceFrame, ...]:
        """The frames the table was made from, in the order taken; empty in computed tables.

        Raises
        ------
        FormatError
            `frames.csv` is damaged.
        """
        return load_frames(self.folder / FRAMES)


def open_lut(folder: Path, *, check: bool = True) -> Lut:
    """Open a LUT folder; costs milliseconds whatever its size.

    Parameters
    ----------
    folder
        The table.
    check
        Whether its files but the samples are held against their recorded hashes; `calibration.table.verification` does
        so itself, to name all that have changed. Samples are held against theirs when a light is first used.

    Raises
    ------
    FormatError
        The folder is no table, of a version not known here, a file has changed since it was built, or its files
        disagree.
    """
    path = folder / PROVENANCE
    require_plain_table(folder)
    try:
        text = path.read_bytes()
    except OSError as error:
        if (partial_path(folder) / SAMPLES).is_file():
            raise FormatError(
                f"{folder} is a table in the making; finish it with build-lut SESSION {folder}"
            ) from error
        raise FormatError(
            f"{folder} is no table: cannot read {PROVENANCE} ({error.strerror}); make one with build-lut"
        ) from error
    provenance = parse_provenance(text, path)
    lights = load_illuminations(folder / ILLUMINATIONS, computed=True)
    white = _load_white(folder / ILLUMINATIONS)
    if check:
        require_listed(folder, provenance, len(lights))
    return Lut(folder, map_samples(folder / SAMPLES, len(lights), provenance.bits), lights, white, provenance)


def _load_uncertainty(path: Path, count: int) -> npt.NDArray[np.float64]:
    """Return the expanded uncertainties (count,) float64 of the lights."""
    try:
        rows = csv.DictReader(io.StringIO(path.read_text(encoding="utf-8")))
        found = np.array([float(row[EXPANDED]) for row in rows])
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise FormatError(f"{path} is damaged: numbers under {EXPANDED} expected; {RESTORE}") from error
    if len(found) != count or not np.isfinite(found).all() or (found < 0).any():
        raise FormatError(f"{path} has {len(found)} rows, {count} of finite numbers from 0 on expected; {RESTORE}")
    return found


def _load_white(path: Path) -> npt.NDArray[np.float64]:
    rows = list(csv.DictReader(io.StringIO(path.read_text(encoding="utf-8-sig"))))
    try:
        white = np.array([[float(row[column]) for column in WHITE_COLUMNS] for row in rows])
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(f"{path}: expected numbers under {','.join(WHITE_COLUMNS)}; build the table again") from error
    if not ((white > 0).all() and (white < MOST_WHITE).all()):
        raise FormatError(f"{path}: a ground truth is not between 0 and {MOST_WHITE}; build the table again")
    return white


def require_lut(given: object) -> None:
    """Refuse what is no table, such as the path of one, or a picture in its place."""
    if not isinstance(given, Lut):
        raise InputError(f"the table is {value_text(given)}, expected a Lut, which open_lut(FOLDER) returns, as first")
