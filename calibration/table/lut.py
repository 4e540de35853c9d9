"""The look-up table on disk: one reader, one writer, nothing about how its numbers were measured.

A LUT folder holds `samples.npy` (uint16 little-endian, C order, [light, colour, sample, RGB]), `illuminations.csv`
(the lights and their ground truth), `lut.json` (provenance), and `frames.csv` (the frames it was made of). The
generator knows this file and nothing behind it.

Laws that hold inside:

- Every version of the format that was ever released is read for ever. Keys added since are optional.
- A folder without `lut.json` is no table: it is written last.
"""

from __future__ import annotations

import csv
import hashlib
import io
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from acquisition.lights.illuminations import COLUMNS, Illumination, load_illuminations
from foundation.errors import FormatError, InputError, StorageError, first_of
from foundation.files import partial_path, storage_error, write_whole
from foundation.hashing import file_sha256

FORMAT = "crop.lut"
VERSION = 1
SAMPLES = "samples.npy"
FRAMES = "frames.csv"
FRAME_COLUMNS = ("kind", "illumination", "file", "sha256")
WHITE_COLUMNS = ("white_r", "white_g", "white_b")


class Unfit(BaseModel):
    """A cell whose samples must not be used, and why."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    colour: int = Field(ge=0)
    cause: str


class Provenance(BaseModel):
    """The content of `lut.json`.

    Attributes
    ----------
    camera
        Maker and model as the raw files name it.
    bits
        Bits kept of each channel; the table has 8**bits colours.
    white_level
        Sample value of sensor saturation: linear camera RGB after black subtraction.
    corrections
        What was applied to the counts, with its parameters, in order.
    session_sha256, chart_sha256
        Hash over the frames' hashes, and of the chart.
    software
        Name and version of the program that built the table.
    unfit
        Cells unfit for use.
    samples_sha256, illuminations_sha256
        Of the files; None in tables made before they were recorded.
    lights_sha256
        Of each light's samples as they lie in the file, in the order of lights, so that damage is told to the light;
        empty in tables made before they were recorded.
    files_sha256
        Of further files of the table, `references.csv`; empty in tables made before they were recorded.
    """

    model_config = ConfigDict(frozen=True, extra="ignore")

    format: Literal["crop.lut"] = FORMAT
    version: Literal[1] = VERSION
    camera: str
    bits: int = Field(ge=1, le=5)
    white_level: int = Field(ge=1, le=65535)
    corrections: list[dict[str, Any]] = []
    session_sha256: str
    chart_sha256: str
    software: str
    unfit: list[Unfit] = []
    samples_sha256: str | None = None
    illuminations_sha256: str | None = None
    lights_sha256: list[str] = []
    files_sha256: dict[str, str] = {}


@dataclass(frozen=True)
class Frame:
    """A raw file that a table was made of; `file` relative to its session, `illumination` None for white frames."""

    kind: str
    illumination: int | None
    file: str
    sha256: str


class _Head(BaseModel):
    format: Any = None
    version: Any = None


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

    @cached_property
    def ground_truth(self) -> npt.NDArray[np.float64]:
        """(L, 3) float64, the lights' chromaticities, r + g + b = 1."""
        return self.white / self.white.sum(axis=1, keepdims=True)

    @cached_property
    def sha256(self) -> str:
        """SHA-256 over the folder's provenance and ground truth, the table's name in a dataset.

        `lut.json` holds the hash of the samples, so it stands for them without reading gigabytes. In tables made
        before that was recorded it holds the hash over all frames, from which the samples came.
        """
        digest = hashlib.sha256()
        for name in ("lut.json", "illuminations.csv"):
            digest.update((self.folder / name).read_bytes())
        return digest.hexdigest()

    def require_unchanged(self, light: int) -> None:
        """Raise unless a light's samples are those that were measured; costs the reading of a light, once for each.

        Does nothing for tables made before hashes of lights were recorded.

        Raises
        ------
        FormatError
            They are not.
        """
        known = self.provenance.lights_sha256
        if light in self._unchanged or light >= len(known):
            return
        if hashlib.sha256(np.ascontiguousarray(self.samples[light]).data).hexdigest() != known[light]:
            raise FormatError(
                f"{self.folder / SAMPLES}: the samples of light {light} are not those that were measured; see what "
                f"else has changed with build-lut --verify {self.folder}, then copy the table again or build it anew"
            )
        self._unchanged.add(light)

    @cached_property
    def _unchanged(self) -> set[int]:
        return set()

    @cached_property
    def frames(self) -> tuple[Frame, ...]:
        """The frames the table was made of, in the order taken; empty in tables made before they were recorded.

        Raises
        ------
        FormatError
            `frames.csv` is damaged.
        """
        path = self.folder / FRAMES
        if not path.is_file():
            return ()
        try:
            rows = list(csv.DictReader(io.StringIO(path.read_text(encoding="utf-8"))))
            return tuple(
                Frame(
                    row["kind"], int(row["illumination"]) if row["illumination"] else None, row["file"], row["sha256"]
                )
                for row in rows
            )
        except (OSError, KeyError, TypeError, ValueError) as error:
            raise FormatError(
                f"{path} is damaged: columns {','.join(FRAME_COLUMNS)} expected; build the table again"
            ) from error


def open_lut(folder: Path) -> Lut:
    """Open a LUT folder; costs milliseconds whatever its size.

    Raises
    ------
    FormatError
        The folder is no table, of a version not known here, or its files disagree.
    """
    path = folder / "lut.json"
    try:
        text = path.read_bytes()
    except OSError as error:
        if (partial_path(folder) / SAMPLES).is_file():
            raise FormatError(
                f"{folder} is a table in the making; finish it with build-lut SESSION {folder}"
            ) from error
        raise FormatError(
            f"{folder} is no table: cannot read lut.json ({error.strerror}); make one with build-lut"
        ) from error
    try:
        head = _Head.model_validate_json(text)
    except ValidationError as error:
        raise FormatError(f"{path} is no table's description: it is damaged; build the table again") from error
    if head.format != FORMAT:
        raise FormatError(f"{path} is no table of CroP: its format is not {FORMAT!r}; name a folder made by build-lut")
    if head.version != VERSION:
        raise FormatError(
            f"{folder} is a table of version {head.version!r}, this software reads version {VERSION}; "
            "build it again from its session with build-lut, or install the software that wrote it"
        )
    try:
        provenance = Provenance.model_validate_json(text)
    except ValidationError as error:
        first = error.errors()[0]
        raise FormatError(f"{path} is damaged: {'.'.join(map(str, first['loc']))}: {first['msg']}") from error
    lights = load_illuminations(folder / "illuminations.csv")
    white = _load_white(folder / "illuminations.csv")
    try:
        samples = np.load(folder / SAMPLES, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise FormatError(f"cannot read {folder / SAMPLES}: {error}; build the table again") from error
    expected = (len(lights), 8**provenance.bits)
    if samples.dtype != np.dtype("<u2") or samples.ndim != 4 or samples.shape[:2] != expected or samples.shape[3] != 3:
        raise FormatError(
            f"{folder / SAMPLES} holds {samples.dtype} {samples.shape}, expected uint16 "
            f"({expected[0]}, {expected[1]}, samples, 3); build the table again"
        )
    return Lut(folder, samples, lights, white, provenance)


def _load_white(path: Path) -> npt.NDArray[np.float64]:
    rows = list(csv.DictReader(io.StringIO(path.read_text(encoding="utf-8-sig"))))
    try:
        white = np.array([[float(row[column]) for column in WHITE_COLUMNS] for row in rows])
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(f"{path}: expected numbers under {','.join(WHITE_COLUMNS)}; build the table again") from error
    if not (np.isfinite(white).all() and (white > 0).all()):
        raise FormatError(f"{path}: a ground truth is not above 0; build the table again")
    return white


def damage(lut: Lut, progress: Callable[[int, int], None] | None = None) -> list[str]:
    """Return what of a table is not as it was built, each fault in words; reads every byte of it.

    Parameters
    ----------
    progress
        Told how many lights are read, and how many there are.

    Raises
    ------
    InputError
        The table was made before hashes were recorded, so nothing can be said.
    """
    known = lut.provenance
    if known.samples_sha256 is None or len(known.lights_sha256) != len(lut.illuminations):
        raise InputError(
            f"{lut.folder} records no hashes ({known.software} wrote none), so it cannot be verified; "
            "build it again from its session"
        )
    faults: list[str] = []
    if file_sha256(lut.folder / "illuminations.csv") != known.illuminations_sha256:
        faults.append("illuminations.csv is not as it was built: lights or ground truth have changed")
    faults += [
        f"{name} is not as it was built, or is gone"
        for name, then in known.files_sha256.items()
        if not (lut.folder / name).is_file() or file_sha256(lut.folder / name) != then
    ]
    whole, lights = _samples_sha256(lut.folder / SAMPLES, lut.samples, progress)
    changed = [light for light, (now, then) in enumerate(zip(lights, known.lights_sha256, strict=True)) if now != then]
    if changed:
        named = first_of(changed, 20)
        faults.append(f"{SAMPLES}: the samples of {len(changed)} of {len(lights)} lights have changed: {named}")
    elif whole != known.samples_sha256:
        faults.append(f"{SAMPLES}: its first bytes, before the samples, have changed")
    try:
        frames = lut.frames
    except FormatError as error:
        faults.append(str(error))
    else:
        if frames_sha256(frames) != known.session_sha256:
            faults.append(f"{FRAMES} does not list the frames that lut.json was made of")
    return faults


def summary(lut: Lut) -> list[tuple[str, str]]:
    """Return what a table is and what it came from, each with its name, for people to read."""
    known, lights = lut.provenance, lut.illuminations
    black_bodies = [light.cct_k for light in lights if light.cct_k is not None]
    kinds = f"{len(lights) - len(black_bodies)} uniform, {len(black_bodies)} black bodies"
    if black_bodies:
        kinds += f" {min(black_bodies):g} to {max(black_bodies):g} K"
    causes: dict[str, int] = {}
    for cell in known.unfit:
        cause = cell.cause.split(":")[0]
        causes[cause] = causes.get(cause, 0) + 1
    brightest = lut.white.max(axis=1)
    low, high = lut.ground_truth.min(axis=0), lut.ground_truth.max(axis=0)
    chromaticities = ", ".join(
        f"{channel} {least:.3f} to {most:.3f}"
        for channel, least, most in zip("rgb", low.tolist(), high.tolist(), strict=True)
    )
    frames = f"{len(lut.frames)}, listed in {FRAMES}" if lut.frames else "not listed"
    return [
        ("Camera", known.camera),
        ("Lights", f"{len(lights)}: {kinds}"),
        ("Colours", f"{8**known.bits} ({known.bits} bits a channel), {lut.samples.shape[2]} samples each"),
        ("Size", f"{lut.samples.nbytes / 1e9:.2f} GB of samples"),
        (
            "White",
            f"{brightest.min():.0f} to {brightest.max():.0f} in the brightest channel, saturation {known.white_level}",
        ),
        ("Chromaticities", chromaticities),
        (
            "Cells unfit",
            f"{len(known.unfit)} of {8**known.bits}"
            + "".join(f", {count} {cause}" for cause, count in sorted(causes.items())),
        ),
        ("Corrections", ", ".join(str(correction.get("name", "?")) for correction in known.corrections)),
        ("Software", known.software),
        ("Frames", frames),
        ("Session", known.session_sha256),
        ("Chart", known.chart_sha256),
        ("Samples", known.samples_sha256 or "no hash recorded"),
        ("Table", lut.sha256),
    ]


def require_match(one: Lut, other: Lut) -> None:
    """Refuse two tables whose colours or lights do not correspond number by number.

    Tables of one chart under one list of lights, photographed by two bodies or on two days, pass: colour index and
    light index then mean the same in both.

    Raises
    ------
    FormatError
        The chart, its bits, or the lights differ; the message says in what.
    """
    ours, theirs = one.provenance, other.provenance
    found: list[str] = []
    if ours.bits != theirs.bits:
        found.append(f"{ours.bits} bits of each channel against {theirs.bits}")
    elif ours.chart_sha256 != theirs.chart_sha256:
        found.append(f"chart {ours.chart_sha256[:12]}… against {theirs.chart_sha256[:12]}…")
    if len(one.illuminations) != len(other.illuminations):
        found.append(f"{len(one.illuminations)} lights against {len(other.illuminations)}")
    else:
        pairs = zip(one.illuminations, other.illuminations, strict=True)
        differing = [light.index for light, counterpart in pairs if light != counterpart]
        if differing:
            found.append(f"other codes under {len(differing)} lights: {first_of(differing)}")
    if found:
        raise FormatError(
            f"{one.folder} and {other.folder} do not correspond: {'; '.join(found)}; "
            "name two tables of one chart.json and one illuminations.csv"
        )


def frames_sha256(frames: Sequence[Frame]) -> str:
    """Return the hash that names a session: SHA-256 over kind, light and hash of each frame used, a line each."""
    lines = [f"{frame.kind},{frame.illumination},{frame.sha256}\n" for frame in frames]
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def _samples_sha256(
    path: Path, samples: npt.NDArray[np.uint16], progress: Callable[[int, int], None] | None = None
) -> tuple[str, list[str]]:
    """Return the hash of the file, and of each light's part of it, read once and in order."""
    whole, lights = hashlib.sha256(), list[str]()
    size = samples[0].nbytes
    try:
        with path.open("rb") as stream:
            whole.update(stream.read(path.stat().st_size - len(samples) * size))
            for light in range(len(samples)):
                slab = stream.read(size)
                whole.update(slab)
                lights.append(hashlib.sha256(slab).hexdigest())
                if progress is not None:
                    progress(light + 1, len(samples))
    except OSError as error:
        raise FormatError(f"cannot read {path}: {error.strerror}; check the disk, or build the table again") from error
    return whole.hexdigest(), lights


class LutWriter:
    """Fills a new LUT folder light by light; the folder is the caller's to rename into place.

    The samples' whole size is claimed at the start, so that a full disk is met before the work and not in its midst.

    Parameters
    ----------
    folder
        Where the table is made.
    lights, colours, samples
        Its shape.
    written
        SHA-256 of the samples of lights that an earlier writer put into this folder; they are left as they are.
    """

    def __init__(
        self, folder: Path, lights: int, colours: int, samples: int, written: dict[int, str] | None = None
    ) -> None:
        self._folder = folder
        self._path = folder / SAMPLES
        self._shape = (lights, colours, samples, 3)
        self._size = colours * samples * 6
        self.sha256: dict[int, str] = dict(written or {})
        header = io.BytesIO()
        np.lib.format.write_array_header_1_0(header, {"descr": "<u2", "fortran_order": False, "shape": self._shape})
        self._offset = len(header.getvalue())
        try:
            with self._path.open("wb" if written is None else "r+b") as stream:
                stream.write(header.getvalue())
                stream.flush()
                os.posix_fallocate(stream.fileno(), self._offset, lights * self._size)
        except OSError as error:
            raise storage_error(self._path, error) from error

    def put(self, light: int, samples: npt.NDArray[np.uint16]) -> None:
        """Store the samples (colours, samples, 3) uint16 of light number `light`."""
        data = np.ascontiguousarray(np.broadcast_to(samples, self._shape[1:]), dtype="<u2").tobytes()
        try:
            with self._path.open("r+b") as stream:
                stream.seek(self._offset + light * self._size)
                stream.write(data)
        except OSError as error:
            raise storage_error(self._path, error) from error
        self.sha256[light] = hashlib.sha256(data).hexdigest()

    def flush(self) -> None:
        """Bring what was put to the disk."""
        try:
            with self._path.open("r+b") as stream:
                os.fsync(stream.fileno())
        except OSError as error:
            raise storage_error(self._path, error) from error

    def damaged(self) -> list[int]:
        """Return the lights whose samples on the disk are not what was put."""
        samples = np.load(self._path, mmap_mode="r", allow_pickle=False)
        return [
            light
            for light, known in self.sha256.items()
            if hashlib.sha256(memoryview(samples[light]).cast("B")).hexdigest() != known
        ]

    def finish(
        self,
        illuminations: Sequence[Illumination],
        white: npt.NDArray[np.float64],
        provenance: Provenance,
        frames: Sequence[Frame] = (),
        files: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        """Write the frames, the ground truth and the provenance; after this the folder is a table.

        Parameters
        ----------
        illuminations
            The L lights.
        white
            (L, 3) float64, the ground truth.
        provenance
            The content of `lut.json`; the hashes of samples and lights are added here.
        frames
            What the table was made of, in the order taken.
        files
            Further files of the table, their text by name.

        Raises
        ------
        StorageError
            The disk is full or read-only, or did not keep what was written to it.
        """
        self.flush()
        whole, lights = _samples_sha256(self._path, np.load(self._path, mmap_mode="r", allow_pickle=False))
        lost = [light for light, known in self.sha256.items() if lights[light] != known]
        if lost:
            raise StorageError(
                f"{self._path}: the samples of lights {', '.join(map(str, lost[:10]))} read back are not those "
                "written; check the disk, then build the table on another"
            )
        rows = [
            [
                light.index,
                light.kind,
                "" if light.cct_k is None else f"{light.cct_k:g}",
                light.colour.red,
                light.colour.green,
                light.colour.blue,
                *(f"{value:.6f}" for value in values),
            ]
            for light, values in zip(illuminations, white, strict=True)
        ]
        truth = _csv_text([*COLUMNS, *WHITE_COLUMNS], rows)
        write_whole(self._folder / "illuminations.csv", truth)
        if frames:
            write_whole(
                self._folder / FRAMES,
                _csv_text(
                    FRAME_COLUMNS,
                    [
                        [frame.kind, "" if frame.illumination is None else frame.illumination, frame.file, frame.sha256]
                        for frame in frames
                    ],
                ),
            )
        for name, text in files.items():
            write_whole(self._folder / name, text)
        hashes = {
            "files_sha256": {name: hashlib.sha256(text.encode()).hexdigest() for name, text in files.items()},
            "samples_sha256": whole,
            "illuminations_sha256": hashlib.sha256(truth.encode()).hexdigest(),
            "lights_sha256": lights,
        }
        text = provenance.model_copy(update=hashes).model_dump_json(indent=2)
        write_whole(self._folder / "lut.json", text + "\n")


def _csv_text(columns: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    return text.getvalue()
