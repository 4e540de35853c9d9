"""Write the files of a look-up table (LUT), `lut.json` last (docs/formats.md)."""

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
    sums_text,
)
from experiment.lights import COLUMNS, NAME, Illuminant
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
    """Writes a new LUT folder, one illuminant at a time; the caller renames the folder when it is complete.

    Disk space for all samples is allocated first, so that a full disk is detected at the start.
    """

    def __init__(
        self, folder: Path, lights: int, colours: int, samples: int, written: dict[int, str] | None = None
    ) -> None:
        self._folder = folder
        self._path = folder / SAMPLES
        self._shape = (lights, colours, samples, 3)
        self._size = colours * samples * 6
        # SHA-256 of the samples of each written illuminant, by index
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
        """Write the samples (colours, samples, 3) uint16 of illuminant number `light`."""
        data = np.ascontiguousarray(np.broadcast_to(samples, self._shape[1:]), dtype="<u2").tobytes()
        try:
            with self._path.open("r+b") as stream:
                stream.seek(self._offset + light * self._size)
                stream.write(data)
        except OSError as error:
            raise storage_error(self._path, error) from error
        self.sha256[light] = sha256_of(data)

    def get(self, light: int) -> npt.NDArray[np.uint16]:
        """Read back the samples (colours, samples, 3) uint16 of illuminant number `light`."""
        return np.array(np.load(self._path, mmap_mode="r", allow_pickle=False)[light])

    def flush(self) -> None:
        """Wait until all samples are on the disk (`fsync`)."""
        try:
            with self._path.open("r+b") as stream:
                os.fsync(stream.fileno())
        except OSError as error:
            raise storage_error(self._path, error) from error

    def damaged(self) -> list[int]:
        """Return the illuminants with damaged samples: their hash on disk differs from the hash when written."""
        samples = np.load(self._path, mmap_mode="r", allow_pickle=False)
        return [light for light, written_hash in self.sha256.items() if light_sha256(samples[light]) != written_hash]

    def finish(
        self,
        illuminations: Sequence[Illuminant],
        white: npt.NDArray[np.float64],
        provenance: Provenance,
        frames: Sequence[SourceFrame] = (),
        files: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        """Write frames, ground truth, hashes and provenance; after this the folder is a LUT.

        The report must already be in the folder, because its hash is recorded.

        `white`: (L, 3) float64, ground truth. `files`: text of further files by name.
        """
        self.flush()
        file_hash, lights = samples_sha256(self._path, np.load(self._path, mmap_mode="r", allow_pickle=False))
        damaged = [light for light, written_hash in self.sha256.items() if lights[light] != written_hash]
        if damaged:
            raise StorageError(
                f"{self._path}: the samples of illuminants {', '.join(map(str, damaged[:10]))} on disk differ from the "
                "written samples; check the disk, then build the LUT on another disk"
            )
        truth = _ground_truth_csv(illuminations, white)
        write_atomic(self._folder / ILLUMINATIONS, truth)
        if frames:
            write_atomic(self._folder / FRAMES, frames_csv(frames))
        for name, text in files.items():
            write_atomic(self._folder / name, text)
        hashes = {
            "files_sha256": {name: sha256_of(text.encode()) for name, text in files.items()},
            "samples_sha256": file_hash,
            "illuminations_sha256": sha256_of(truth.encode()),
            "lights_sha256": lights,
            "has_sums": True,
        }
        description = provenance.model_copy(update=hashes).to_json()
        write_atomic(self._folder / SUMS, sums_text(self._folder, file_hash, sha256_of(description.encode())))
        write_atomic(self._folder / PROVENANCE, description)


def _ground_truth_csv(illuminations: Sequence[Illuminant], white: npt.NDArray[np.float64]) -> str:
    has_names = any(light.name is not None for light in illuminations)
    rows = (
        [
            light.index,
            light.kind,
            None if light.cct_k is None else f"{light.cct_k:g}",
            *light.colour,
            *(f"{value:.6f}" for value in values),
            *([light.name] if has_names else []),
        ]
        for light, values in zip(illuminations, white, strict=True)
    )
    return csv_text([[*COLUMNS, *WHITE_COLUMNS, *([NAME] if has_names else [])], *rows])


def references_csv(names: Sequence[str], white: _Array, white_error: _Array, greys: _Array, errors: _Array) -> str:
    """Return the text of `references.csv`: for each illuminant the white reference, then the grey references.

    `white`, `white_error`: (L, 3), values and uncertainties in the units of the samples. `greys`, `errors`: (L, G, 3),
    same units; NaN is written as an empty field.
    """
    values = np.concatenate([white[:, None], greys], axis=1)
    all_errors = np.concatenate([white_error[:, None], errors], axis=1)
    rows = (
        [light, name, *(None if np.isnan(number) else f"{number:.6f}" for number in (*value.tolist(), *error.tolist()))]
        for light in range(len(white))
        for name, value, error in zip(("white", *names), values[light], all_errors[light], strict=True)
    )
    return csv_text([REFERENCE_COLUMNS, *rows])
