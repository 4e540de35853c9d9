"""The look-up table on disk: one reader, one writer, nothing about how its numbers were measured.

A LUT folder holds `samples.npy` (uint16 little-endian, C order, [light, colour, sample, RGB]), `illuminations.csv`
(the lights and their ground truth), and `lut.json` (provenance). The generator knows this file and nothing behind it.
"""

from __future__ import annotations

import csv
import hashlib
import io
import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from acquisition.illuminations import COLUMNS, Illumination, load_illuminations
from drivers.errors import FormatError
from drivers.storage import storage_error, write_whole

FORMAT = "crop.lut"
VERSION = 1
SAMPLES = "samples.npy"
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

        `lut.json` holds the hash over all frames, so it stands for the samples without reading gigabytes.
        """
        digest = hashlib.sha256()
        for name in ("lut.json", "illuminations.csv"):
            digest.update((self.folder / name).read_bytes())
        return digest.hexdigest()


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


class LutWriter:
    """Fills a new LUT folder light by light; the folder is the caller's to rename into place.

    The samples' whole size is claimed at the start, so that a full disk is met before the work and not in its midst.
    """

    def __init__(self, folder: Path, lights: int, colours: int, samples: int) -> None:
        self._folder = folder
        self._path = folder / SAMPLES
        try:
            with self._path.open("wb") as stream:
                header = {"descr": "<u2", "fortran_order": False, "shape": (lights, colours, samples, 3)}
                np.lib.format.write_array_header_1_0(stream, header)
                offset = stream.tell()
                size = lights * colours * samples * 6
                os.posix_fallocate(stream.fileno(), offset, size)
        except OSError as error:
            raise storage_error(self._path, error) from error
        self._samples = np.load(self._path, mmap_mode="r+")

    def put(self, light: int, samples: npt.NDArray[np.uint16]) -> None:
        """Store the samples (colours, samples, 3) uint16 of light number `light`."""
        self._samples[light] = samples

    def finish(
        self, illuminations: Sequence[Illumination], white: npt.NDArray[np.float64], provenance: Provenance
    ) -> None:
        """Write the ground truth and the provenance; after this the folder is a table."""
        self._samples.flush()
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow([*COLUMNS, *WHITE_COLUMNS])
        for light, values in zip(illuminations, white, strict=True):
            cct = "" if light.cct_k is None else f"{light.cct_k:g}"
            writer.writerow(
                [
                    light.index,
                    light.kind,
                    cct,
                    light.colour.red,
                    light.colour.green,
                    light.colour.blue,
                    *(f"{value:.6f}" for value in values),
                ]
            )
        write_whole(self._folder / "illuminations.csv", text.getvalue())
        write_whole(self._folder / "lut.json", provenance.model_dump_json(indent=2) + "\n")
