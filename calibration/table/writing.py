"""A table is written: samples light by light, its ground truth, and its description last (docs/formats.md)."""

from __future__ import annotations

import io
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Final

import numpy as np
import numpy.typing as npt

from calibration.table.lut import (
    FRAME_FIELDS,
    FRAMES,
    ILLUMINATIONS,
    PROVENANCE,
    SAMPLES,
    SUMS,
    WHITE_COLUMNS,
    Provenance,
    SourceFrame,
    light_sha256,
    samples_sha256,
    sums_of,
)
from experiment.lights import COLUMNS, NAME, Illumination
from foundation.errors import StorageError
from foundation.files import csv_text, sha256_of, storage_error, write_atomic

_Array = npt.NDArray[np.float64]

# Columns of a table's `references.csv` (docs/formats.md).
REFERENCE_COLUMNS: Final = ("light", "name", "r", "g", "b", "r_error", "g_error", "b_error")


def frames_csv(frames: Sequence[SourceFrame]) -> str:
    """Return the text of `frames.csv`."""
    rows = ([frame.kind, frame.illumination, frame.file, frame.sha256] for frame in frames)
    return csv_text([FRAME_FIELDS, *rows])


class LutWriter:
    """Fills a new LUT folder light by light; the folder is the caller's to rename into place.

    The samples' whole size is claimed at the start, so that a full disk is met before the work and not in its midst.

    `sha256`: SHA-256 of the samples of each light that was put, by its number.
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
        self.sha256[light] = sha256_of(data)

    def get(self, light: int) -> npt.NDArray[np.uint16]:
        """Return the samples (colours, samples, 3) uint16 that were put for light number `light`, from the disk."""
        return np.array(np.load(self._path, mmap_mode="r", allow_pickle=False)[light])

    def flush(self) -> None:
        """Wait until the disk holds what was put (`fsync`)."""
        try:
            with self._path.open("r+b") as stream:
                os.fsync(stream.fileno())
        except OSError as error:
            raise storage_error(self._path, error) from error

    def damaged(self) -> list[int]:
        """Return the lights whose samples on the disk are not what was put."""
        samples = np.load(self._path, mmap_mode="r", allow_pickle=False)
        return [light for light, known in self.sha256.items() if light_sha256(samples[light]) != known]

    def finish(
        self,
        illuminations: Sequence[Illumination],
        white: npt.NDArray[np.float64],
        provenance: Provenance,
        frames: Sequence[SourceFrame] = (),
        files: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        """Write the frames, the ground truth, the hashes and the provenance; after this the folder is a table.

        A report of the table must be in the folder by now: its hash is written too.

        `white`: (L, 3) float64, the ground truth.
        """
        self.flush()
        whole, lights = samples_sha256(self._path, np.load(self._path, mmap_mode="r", allow_pickle=False))
        lost = [light for light, known in self.sha256.items() if lights[light] != known]
        if lost:
            raise StorageError(
                f"{self._path}: the samples of lights {', '.join(map(str, lost[:10]))} read back are not those "
                "written; check the disk, then build the table on another"
            )
        truth = _ground_truth_csv(illuminations, white)
        write_atomic(self._folder / ILLUMINATIONS, truth)
        if frames:
            write_atomic(self._folder / FRAMES, frames_csv(frames))
        for name, text in files.items():
            write_atomic(self._folder / name, text)
        hashes = {
            "files_sha256": {name: sha256_of(text.encode()) for name, text in files.items()},
            "samples_sha256": whole,
            "illuminations_sha256": sha256_of(truth.encode()),
            "lights_sha256": lights,
            "has_sums": True,
        }
        described = provenance.model_copy(update=hashes).to_json()
        write_atomic(self._folder / SUMS, sums_of(self._folder, whole, sha256_of(described.encode())))
        write_atomic(self._folder / PROVENANCE, described)


def _ground_truth_csv(illuminations: Sequence[Illumination], white: npt.NDArray[np.float64]) -> str:
    """Return the text of `illuminations.csv`: the lights with their whites (L, 3), six decimals."""
    named = any(light.name is not None for light in illuminations)
    rows = (
        [
            light.index,
            light.kind,
            None if light.cct_k is None else f"{light.cct_k:g}",
            *light.colour,
            *(f"{value:.6f}" for value in values),
            *([light.name] if named else []),
        ]
        for light, values in zip(illuminations, white, strict=True)
    )
    return csv_text([[*COLUMNS, *WHITE_COLUMNS, *([NAME] if named else [])], *rows])


def references_csv(names: Sequence[str], white: _Array, white_error: _Array, greys: _Array, errors: _Array) -> str:
    """Return the text of `references.csv`: every light's white, then its greys.

    `white`, `white_error`: (L, 3), units of the samples. `greys`, `errors`: (L, G, 3), the same units; NaN is left
    empty.
    """
    values = np.concatenate([white[:, None], greys], axis=1)
    off = np.concatenate([white_error[:, None], errors], axis=1)
    rows = (
        [light, name, *(None if np.isnan(number) else f"{number:.6f}" for number in (*value.tolist(), *error.tolist()))]
        for light in range(len(white))
        for name, value, error in zip(("white", *names), values[light], off[light], strict=True)
    )
    return csv_text([REFERENCE_COLUMNS, *rows])
