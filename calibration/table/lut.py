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

from calibration.table.file_names import FRAMES, ILLUMINATIONS, PROVENANCE, SAMPLES, SUMS
from calibration.table.provenance import Provenance, parse_provenance
from calibration.table.sample_hashes import light_sha256, map_samples
from calibration.table.source_frames import SourceFrame, load_frames
from calibration.table.sums import require_listed, require_plain_table
from experiment.lights import Illumination, load_illuminations
from foundation.errors import FormatError
from foundation.files import partial_path
from foundation.hashing import file_sha256

WHITE_COLUMNS: Final = ("white_r", "white_g", "white_b")
"""Columns of `illuminations.csv` with the ground truth, after those of the lights."""

MOST_WHITE: Final = 1_000_000
"""A ground truth is below this, in units of samples of 16 bits: what is larger was not measured, and its chromaticity
might not be a number."""


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
        """SHA-256 that names the table, as a dataset records it: of `SHA256SUMS`, which has the hash of every file.

        In tables made before that was written it is over `lut.json` and `illuminations.csv`: `lut.json` holds the hash
        of the samples, so it stands for them without reading gigabytes, or at least the hash over all frames, from
        which the samples came.
        """
        return table_sha256(self.folder, self.provenance)

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
    def frames(self) -> tuple[SourceFrame, ...]:
        """The frames the table was made from, in the order taken; empty in tables made before they were recorded.

        Raises
        ------
        FormatError
            `frames.csv` is damaged.
        """
        return load_frames(self.folder / FRAMES)


def table_sha256(folder: Path, provenance: Provenance) -> str:
    """Return the hash that names a table of that `lut.json`; see `Lut.sha256`."""
    if provenance.has_sums:
        return file_sha256(folder / SUMS)
    digest = hashlib.sha256()
    for name in (PROVENANCE, ILLUMINATIONS):
        digest.update((folder / name).read_bytes())
    return digest.hexdigest()


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


def _load_white(path: Path) -> npt.NDArray[np.float64]:
    rows = list(csv.DictReader(io.StringIO(path.read_text(encoding="utf-8-sig"))))
    try:
        white = np.array([[float(row[column]) for column in WHITE_COLUMNS] for row in rows])
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(f"{path}: expected numbers under {','.join(WHITE_COLUMNS)}; build the table again") from error
    if not ((white > 0).all() and (white < MOST_WHITE).all()):
        raise FormatError(f"{path}: a ground truth is not between 0 and {MOST_WHITE}; build the table again")
    return white
