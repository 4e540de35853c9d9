"""The look-up table on disk, opened for reading; nothing about how its numbers were measured.

A LUT folder holds `samples.npy` (uint16 little-endian, C order, [light, colour, sample, RGB]), `illuminations.csv`
(the lights and their ground truth), `lut.json` (provenance), and `frames.csv` (the frames it was made from). The
generator reads tables through this file, and nothing behind it.

Every released version of the format stays readable. Keys added since are optional.
"""

from __future__ import annotations

import csv
import hashlib
import io
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from acquisition.lights.illuminations import Illumination, load_illuminations
from calibration.table.file_names import FRAMES, ILLUMINATIONS, PROVENANCE, SAMPLES
from calibration.table.provenance import Provenance, parse_provenance
from calibration.table.sample_hashes import light_sha256
from calibration.table.source_frames import SourceFrame, load_frames
from foundation.errors import FormatError
from foundation.files import partial_path

WHITE_COLUMNS: Final = ("white_r", "white_g", "white_b")
"""Columns of `illuminations.csv` with the ground truth, after those of the lights."""


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
        for name in (PROVENANCE, ILLUMINATIONS):
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
        if light_sha256(self.samples[light]) != known[light]:
            raise FormatError(
                f"{self.folder / SAMPLES}: the samples of light {light} are not those that were measured; see what "
                f"else has changed with build-lut --verify {self.folder}, then copy the table again or build it anew"
            )
        self._unchanged.add(light)

    @cached_property
    def _unchanged(self) -> set[int]:
        return set()

    @cached_property
    def frames(self) -> tuple[SourceFrame, ...]:
        """The frames the table was made from, in the order taken; empty in tables made before they were recorded.

        Raises
        ------
        FormatError
            `frames.csv` is damaged.
        """
        return load_frames(self.folder / FRAMES)


def open_lut(folder: Path) -> Lut:
    """Open a LUT folder; costs milliseconds whatever its size.

    Raises
    ------
    FormatError
        The folder is no table, of a version not known here, or its files disagree.
    """
    path = folder / PROVENANCE
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
