"""The look-up table (LUT) on disk: its files (docs/formats.md), and how to open it.

The generator reads LUTs through this module; `calibration.table.writing` writes them. Every released version of the
format stays readable. `SHA256SUMS` has the format of `sha256sum`, so a LUT can be verified without this software. The
hash of this file identifies the LUT. Opening a LUT verifies all files except the samples; samples are verified at the
first use of an illuminant.
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
from experiment.lights import Illuminant, load_illuminants
from foundation.errors import FormatError, InputError, value_text
from foundation.files import file_sha256, partial_path, read_text, reading_error, require_plain_folder, sha256_of
from foundation.records import Record, from_json

FORMAT: Final = "crop.lut"

VERSION: Final = 1  # the only version so far

Sha256 = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]  # A SHA-256 as 64 lowercase hexadecimal digits

# Name of a file in the folder of the LUT
FileName = Annotated[str, Field(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}$")]

FRAME_FIELDS: Final = ("kind", "illumination", "file", "sha256")  # columns of `frames.csv`

MOST_SAMPLES: Final = 1024  # largest number of samples per patch; the largest window has 9×9

# Origin and processing of the LUT. This file is written last; a folder without it is incomplete.
PROVENANCE: Final = "lut.json"

SAMPLES: Final = "samples.npy"  # uint16 little-endian, C order, [illuminant, colour, sample, RGB]

ILLUMINATIONS: Final = "illuminations.csv"  # illuminants and their ground truth

FRAMES: Final = "frames.csv"  # raw files of the LUT; absent in computed LUTs

REFERENCES: Final = "references.csv"  # grey references under each illuminant, if the chart has any

# Expanded uncertainty of each ground truth, and its components; absent in computed LUTs
UNCERTAINTY: Final = "uncertainty.csv"

CELLS: Final = "cells.csv"  # expanded relative uncertainty of patch means; absent in computed LUTs

REPORT_PAGE: Final = "report.html"  # report as a page

REPORT_JSON: Final = "report.json"  # report for programs

SUMS: Final = "SHA256SUMS"  # hashes of all other files, for `sha256sum -c`

REPORT_FORMAT: Final = "crop.report"

REPORT_VERSION: Final = 1  # `format` and `version` of `report.json` (docs/formats.md)

# Largest accepted sizes of files, in bytes: about forty times the sizes of a full LUT.
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

# Files that may be missing, because no data are read from them. Fetched LUTs do not have them.
OPTIONAL: Final = frozenset({REPORT_PAGE})

_LINE = re.compile(r"([0-9a-f]{64})  ([A-Za-z0-9_][A-Za-z0-9_.-]{0,99})")  # line of `SHA256SUMS`: hash and file name
# Files besides `lut.json`, samples and hashes.
_TEXTS: Final = (ILLUMINATIONS, FRAMES, REFERENCES, UNCERTAINTY, CELLS, REPORT_JSON, REPORT_PAGE)
RESTORE: Final = "restore it from a copy, fetch the LUT again, or build it again"

# Columns of `illuminations.csv` with the ground truth, after the columns of the illuminants
WHITE_COLUMNS: Final = ("white_r", "white_g", "white_b")

EXPANDED: Final = "expanded_deg"  # column of `uncertainty.csv`

CELL_COLUMNS: Final = ("expanded_r", "expanded_g", "expanded_b")  # columns of `cells.csv` after the colour index

# Upper bound of ground truths, in the units of the samples. A larger value is no measurement, and its chromaticity
# could overflow.
MOST_WHITE: Final = 1_000_000


class Unfit(BaseModel):
    """A patch with samples that must not be used, and the cause."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    colour: int = Field(ge=0)
    cause: str

    @property
    def kind(self) -> str:
        """The cause as one word, without numbers."""
        return self.cause.split(":")[0]


class Provenance(Record):
    """The content of `lut.json`."""

    format: Literal["crop.lut"] = FORMAT
    version: Literal[1] = VERSION
    camera: str  # maker and model from the raw files
    bits: int = Field(ge=1, le=5)  # bits per channel of the codes; the LUT has 8**bits colours
    # sample value at sensor saturation, after black subtraction
    white_level: int = Field(ge=1, le=65535)
    # corrections with their parameters, in the order of application
    corrections: list[dict[str, Any]] = Field(default_factory=list[dict[str, Any]])
    session_sha256: str  # hash over the hashes of all frames (`frames_sha256`)
    chart_sha256: str
    software: str
    unfit: list[Unfit] = Field(default_factory=list[Unfit])
    samples_sha256: Sha256 | None = None  # None until the LUT is written
    illuminations_sha256: Sha256 | None = None
    # hash of the bytes of each illuminant in `samples.npy`, to locate damage
    lights_sha256: list[Sha256] = Field(default_factory=list[Sha256])
    # hashes of further files: `references.csv`
    files_sha256: dict[FileName, Sha256] = Field(default_factory=dict[FileName, Sha256])
    has_sums: bool = False  # `SHA256SUMS` lists all files; false until it is written
    # program and settings, if the LUT was computed from spectra and a sensor model; None if it was built from frames
    computed: dict[str, Any] | None = None
    # equipment, date, author and licence; None in computed LUTs without this information
    origin: OriginRecord | None = None

    def __repr__(self) -> str:
        """Return one line; the hashes alone have 70 bytes for each illuminant."""
        return f"Provenance({self.camera}, {self.bits} bits, saturation {self.white_level}, {self.software})"

    @model_validator(mode="after")
    def _require_colours(self) -> Self:
        invalid = [cell.colour for cell in self.unfit if cell.colour >= 8**self.bits]
        if invalid:
            raise ValueError(f"unfit: colour {invalid[0]}, expected 0 to {8**self.bits - 1} with {self.bits} bits")
        return self

    def to_json(self) -> str:
        """Return the text of `lut.json`, without `computed` and `origin` if they are None."""
        excluded = {name for name in ("computed", "origin") if getattr(self, name) is None}
        return self.model_dump_json(indent=2, exclude=excluded) + "\n"


class _Head(BaseModel):
    format: Any = None
    version: Any = None


def parse_provenance(text: bytes, path: Path) -> Provenance:
    """Parse the bytes of `lut.json`."""
    try:
        head = _Head.model_validate_json(text)
    except ValidationError as error:
        raise FormatError(f"{path} is damaged, expected a JSON object; build the LUT again") from error
    if head.format != FORMAT:
        raise FormatError(f"{path} has format {head.format!r}, expected {FORMAT!r}; give a folder made by build-lut")
    if head.version != VERSION:
        raise FormatError(
            f"{path.parent} is a LUT of version {head.version!r}, expected {VERSION}; "
            "build it again from its session with build-lut, or install the software that wrote it"
        )
    provenance = from_json(Provenance, text, path, "restore it from a copy")
    if not provenance.has_sums:
        raise FormatError(f"{path} does not refer to {SUMS}, expected has_sums = true; {RESTORE}")
    return provenance


@dataclass(frozen=True)
class SourceFrame:
    """A raw file used for a LUT."""

    kind: str  # ``light``, ``white`` or ``dark``
    illumination: int | None  # index of the illuminant; None for white and dark frames
    file: str  # path relative to the session folder
    sha256: str  # hash of the file


def frames_sha256(frames: Sequence[SourceFrame]) -> str:
    """Return the hash that identifies a session: SHA-256 over one line of kind, index and hash for each frame."""
    lines = [f"{frame.kind},{frame.illumination},{frame.sha256}\n" for frame in frames]
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def load_frames(path: Path) -> tuple[SourceFrame, ...]:
    """Return the frames of a `frames.csv` in the order of exposure; empty if the file does not exist."""
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
            f"{path} is damaged, expected columns {','.join(FRAME_FIELDS)}; build the LUT again"
        ) from error


def light_sha256(samples: npt.NDArray[np.uint16]) -> str:
    """Return the SHA-256 of the samples (8**bits, S, 3) uint16 of one illuminant, as stored in `samples.npy`."""
    return sha256_of(np.ascontiguousarray(samples, dtype="<u2").data)


def map_samples(path: Path, lights: int, bits: int) -> npt.NDArray[np.uint16]:
    """Memory-map `samples.npy`: (illuminants, 8**bits, samples, 3) uint16."""
    try:
        with path.open("rb") as stream:
            version = np.lib.format.read_magic(stream)
            if version != (1, 0):
                raise ValueError(f"its version is {version[0]}.{version[1]}, expected 1.0")
            shape, columns_first, dtype = np.lib.format.read_array_header_1_0(stream)
            offset, size = stream.tell(), stream.seek(0, 2)
    except OSError as error:
        raise reading_error(path, error, "build the LUT again") from error
    except Exception as error:
        # The header is a Python literal, which can raise many kinds of errors.
        raise FormatError(f"cannot read {path}: {error}; restore it from a copy, or build the LUT again") from error
    is_plain = dtype == np.dtype("<u2") and not columns_first and len(shape) == 4
    if not is_plain or shape[:2] != (lights, 8**bits) or not 0 < shape[2] <= MOST_SAMPLES or shape[3] != 3:
        raise FormatError(
            f"{path} has {dtype} {shape}, expected uint16 ({lights}, {8**bits}, samples, 3) of 1 to {MOST_SAMPLES} "
            "samples; build the LUT again"
        )
    expected = offset + math.prod(shape) * 2
    if size != expected:
        raise FormatError(
            f"{path} has {size} bytes, expected {expected}; restore it from a copy, or build the LUT again"
        )
    return np.memmap(path, dtype, "r", offset, shape)


def samples_sha256(
    path: Path, samples: npt.NDArray[np.uint16], progress: Callable[[int, int], None] | None = None
) -> tuple[str, list[str]]:
    """Return the hash of `samples.npy` and the hash of the samples of each illuminant; reads the file once.

    `samples`: (L, 8**bits, S, 3) uint16, the same file, memory-mapped; only its shape is used.
    """
    file_hash, lights = hashlib.sha256(), list[str]()
    size = samples[0].nbytes
    try:
        with path.open("rb") as stream:
            file_hash.update(stream.read(path.stat().st_size - len(samples) * size))
            for light in range(len(samples)):
                slab = stream.read(size)
                file_hash.update(slab)
                lights.append(sha256_of(slab))
                if progress is not None:
                    progress(light + 1, len(samples))
    except OSError as error:
        raise FormatError(f"cannot read {path}: {error.strerror}; check the disk, or build the LUT again") from error
    return file_hash.hexdigest(), lights


def sums_text(folder: Path, samples_sha256: str, provenance: str) -> str:
    """Return the text of `SHA256SUMS` for a LUT without its `lut.json`; `provenance` is the hash of `lut.json`."""
    hashes = {name: file_sha256(folder / name) for name in _TEXTS if (folder / name).is_file()}
    hashes |= {SAMPLES: samples_sha256, PROVENANCE: provenance}
    return "".join(f"{hashes[name]}  {name}\n" for name in sorted(hashes))


def parse_sums(text: str, path: Path) -> dict[str, str]:
    """Return the hashes of the files of a LUT by name."""
    hashes: dict[str, str] = {}
    for number, line in enumerate(text.splitlines(), 1):
        match = _LINE.fullmatch(line)
        if match is None or match[2] in hashes:
            raise FormatError(
                f"{path}, line {number}: {line[:80]!r}, expected a hash, two blanks and a unique name; {RESTORE}"
            )
        hashes[match[2]] = match[1]
    missing = {PROVENANCE, ILLUMINATIONS, SAMPLES} - hashes.keys()
    if missing:
        raise FormatError(f"{path} does not list {' and '.join(sorted(missing))}, which every LUT has; {RESTORE}")
    return hashes


def require_plain_table(folder: Path) -> None:
    """Raise `FormatError` if the folder has an entry that is no regular file, or a file above its largest size."""
    require_plain_folder(folder, MOST_BYTES)


def recorded_sums(folder: Path) -> dict[str, str]:
    """Return the recorded hashes of the files of a LUT by name, including `samples.npy`."""
    return parse_sums(read_text(folder / SUMS, RESTORE), folder / SUMS)


def changed_files(folder: Path, recorded: Mapping[str, str]) -> Iterator[str]:
    """Yield a message for each file, except samples, that has changed, is missing or is not listed."""
    for name, expected_hash in recorded.items():
        path = folder / name
        if name == SAMPLES or (name in OPTIONAL and not path.exists()):
            continue
        if not path.is_file():
            yield f"{name} is missing"
        elif file_sha256(path) != expected_hash:
            yield f"{name} has changed since the build" + ": codes or ground truth" * (name == ILLUMINATIONS)
    # Files with other names are ignored, because nothing reads them.
    yield from (
        f"{name} was added after the build" for name in _TEXTS if name not in recorded and (folder / name).exists()
    )


def require_listed(folder: Path, provenance: Provenance, lights: int) -> dict[str, str]:
    """Verify all files except samples, and return their recorded hashes."""
    hashes = len(provenance.lights_sha256)
    if hashes != lights:
        raise FormatError(f"{folder / PROVENANCE} has hashes of {hashes} illuminants, expected {lights}; {RESTORE}")
    recorded = recorded_sums(folder)
    for fault in changed_files(folder, recorded):
        raise FormatError(f"{folder}: {fault}; {RESTORE}")
    return recorded


@dataclass(frozen=True, eq=False)
class Lut:
    """A look-up table (LUT). Samples are memory-mapped, and read when they are used.

    Attributes
    ----------
    folder : Path
    samples : (L, 8**bits, S, 3) uint16
        Linear camera RGB; `provenance.white_level` is saturation.
    illuminations : tuple of Illuminant
        The L illuminants.
    white : (L, 3) float64
        Ground truth: linear camera RGB of the achromatic reference in the units of the samples.
    provenance : Provenance
        Content of `lut.json`.
    """

    folder: Path
    samples: npt.NDArray[np.uint16]
    illuminations: tuple[Illuminant, ...]
    white: npt.NDArray[np.float64]
    provenance: Provenance

    def __repr__(self) -> str:
        """Return one line; the provenance alone would be several hundred kilobytes."""
        lights, colours, samples, _ = self.samples.shape
        sizes = f"{lights} illuminants, {colours} colours, {samples} samples each"
        return f"Lut({str(self.folder)!r}, {self.provenance.camera}, {sizes})"

    @cached_property
    def ground_truth(self) -> npt.NDArray[np.float64]:
        """(L, 3) float64, chromaticities of the illuminants, r + g + b = 1."""
        return self.white / self.white.sum(axis=1, keepdims=True)

    @cached_property
    def sha256(self) -> str:
        """SHA-256 of `SHA256SUMS`, which identifies the LUT; recorded in data sets."""
        return file_sha256(self.folder / SUMS)

    def require_unchanged(self, light: int) -> None:
        """Verify the samples of an illuminant, by reading them once.

        Raises
        ------
        FormatError
            If they have changed since the build.
        """
        if light in self._unchanged:
            return
        if light_sha256(self.samples[light]) != self.provenance.lights_sha256[light]:
            raise FormatError(
                f"{self.folder / SAMPLES}: the hash of the samples of illuminant {light} differs from {PROVENANCE}; "
                f"list all changes with build-lut verify {self.folder}, then copy the LUT again or build it again"
            )
        self._unchanged.add(light)

    def light_samples(self, light: int) -> npt.NDArray[np.uint16]:
        """Return the verified samples (8**bits, S, 3) uint16 of an illuminant, memory-mapped.

        Raises
        ------
        FormatError
            If they have changed since the build.
        """
        self.require_unchanged(light)
        return self.samples[light]

    @cached_property
    def _unchanged(self) -> set[int]:
        return set()

    @cached_property
    def truth_uncertainty_deg(self) -> npt.NDArray[np.float64] | None:
        """(L,) float64, degrees: expanded uncertainty (k = 2) of the ground truth; None in computed LUTs.

        Raises
        ------
        FormatError
            If `uncertainty.csv` is damaged.
        """
        path = self.folder / UNCERTAINTY
        return _load_uncertainty(path, len(self.illuminations)) if path.is_file() else None

    @cached_property
    def frames(self) -> tuple[SourceFrame, ...]:
        """Frames of the LUT in the order of exposure; empty in computed LUTs.

        Raises
        ------
        FormatError
            If `frames.csv` is damaged.
        """
        return load_frames(self.folder / FRAMES)


def open_lut(folder: Path, *, check: bool = True) -> Lut:
    """Open a LUT folder.

    Parameters
    ----------
    folder : Path
    check : bool
        Whether to verify the hashes of all files except samples. Samples are verified at the first use of an
        illuminant.

    Raises
    ------
    FormatError
        If the folder is not a LUT, its version is unknown, or a file is damaged or has changed since the build.
    """
    path = folder / PROVENANCE
    require_plain_table(folder)
    try:
        text = path.read_bytes()
    except OSError as error:
        if (partial_path(folder) / SAMPLES).is_file():
            raise FormatError(f"{folder} is not complete; complete it with build-lut SESSION {folder}") from error
        # A Path has one slash less than its URL.
        remedy = "copy it with build-lut fetch URL FOLDER" if ":/" in str(folder) else "make one with build-lut"
        raise FormatError(f"{folder} is not a LUT: cannot read {PROVENANCE} ({error.strerror}); {remedy}") from error
    provenance = parse_provenance(text, path)
    lights = load_illuminants(folder / ILLUMINATIONS, computed=True)
    white = _load_white(folder / ILLUMINATIONS)
    if check:
        require_listed(folder, provenance, len(lights))
    return Lut(folder, map_samples(folder / SAMPLES, len(lights), provenance.bits), lights, white, provenance)


def _load_uncertainty(path: Path, count: int) -> npt.NDArray[np.float64]:
    try:
        rows = csv.DictReader(io.StringIO(path.read_text(encoding="utf-8")))
        expanded = np.array([float(row[EXPANDED]) for row in rows])
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise FormatError(f"{path} is damaged, expected numbers under {EXPANDED}; {RESTORE}") from error
    if len(expanded) != count or not np.isfinite(expanded).all() or (expanded < 0).any():
        raise FormatError(f"{path} has {len(expanded)} rows, expected {count} rows with finite numbers ≥ 0; {RESTORE}")
    return expanded


def _load_white(path: Path) -> npt.NDArray[np.float64]:
    rows = list(csv.DictReader(io.StringIO(path.read_text(encoding="utf-8-sig"))))
    try:
        white = np.array([[float(row[column]) for column in WHITE_COLUMNS] for row in rows])
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(
            f"{path} is damaged, expected numbers under {','.join(WHITE_COLUMNS)}; build the LUT again"
        ) from error
    if not ((white > 0).all() and (white < MOST_WHITE).all()):
        extremes = f"{white.min():g} to {white.max():g}"
        raise FormatError(f"{path}: ground truths from {extremes}, expected 0 to {MOST_WHITE}; build the LUT again")
    return white


def require_lut(value: object) -> None:
    """Raise `InputError` if a value is not a `Lut`, such as a path or an image."""
    if not isinstance(value, Lut):
        raise InputError(
            f"the first argument is {value_text(value)}, expected a Lut, as returned by open_lut(FOLDER); give one"
        )
