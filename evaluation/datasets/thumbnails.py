"""Read thumbnails of a real data set from one NumPy archive, as used for training neural networks.

The archive (`.npz`) contains `images` (N, H, W, 3), float32 or uint16, linear camera RGB minus black level; `gt`
(N, 3), the ground truths; and `names` (N,), the image names. Pixels of masked calibration targets are exactly zero.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from evaluation.datasets.files import check_light
from evaluation.datasets.options import level_note
from evaluation.scene import SceneSet
from foundation.arrays import native
from foundation.errors import FormatError

_EXPECTED = "expected images (N, H, W, 3), gt (N, 3) and names (N,), as numpy.savez writes them"


@dataclass(frozen=True, eq=False)
class Thumbnail:
    """Thumbnail in memory.

    - `name`: name of the image.
    - `truth`: ground truth (3,) float64, linear camera RGB of any scale.
    - `image`: (H, W, 3) float32 or uint16, linear camera RGB minus black level.
    - `saturation`: value from which a pixel is clipped; None if unknown.
    """

    name: str
    truth: npt.NDArray[np.float64]
    image: npt.NDArray[np.float32] | npt.NDArray[np.uint16]
    saturation: float | None = None

    def read(self) -> tuple[npt.NDArray[np.float32] | npt.NDArray[np.uint16], npt.NDArray[np.bool_]]:
        """Return a copy of the image and its mask (H, W) bool, True if all channels are zero."""
        return self.image.copy(), (self.image == 0).all(axis=2)


def open_thumbnails(path: Path | str, saturation: float | None = None) -> SceneSet:
    """Return the thumbnails of an archive, in memory; `saturation` in the units of the archive, None if unknown."""
    try:
        with np.load(path) as content:
            images, truths, names = native(content["images"]), content["gt"].astype(np.float64), content["names"]
    except Exception as error:  # NumPy evaluates file headers, so a damaged file may raise any error.
        raise FormatError(f"{path} cannot be read as thumbnails: {error}; {_EXPECTED}") from error
    count = len(images)
    if images.ndim != 4 or images.shape[3] != 3 or truths.shape != (count, 3) or names.shape != (count,) or not count:
        raise FormatError(
            f"{path} has images {images.shape}, gt {truths.shape} and names {names.shape}; {_EXPECTED}, N from 1"
        )
    if images.dtype.name not in ("uint16", "float32", "float64"):
        raise FormatError(
            f"{path} has images of {images.dtype}, expected uint16, float32 or float64: linear camera RGB"
        )
    printed_names = [name.decode(errors="replace") if isinstance(name, bytes) else str(name) for name in names.tolist()]
    duplicate = next((name for name, times in Counter(printed_names).items() if times > 1), None)
    unprintable = next((name for name in printed_names if not name.isprintable()), None)
    if duplicate is not None or unprintable is not None:
        raise FormatError(
            f"{path} has "
            + (f"two images named {duplicate!r}" if duplicate is not None else f"an image named {unprintable!r}")
            + ", expected unique printable names; rename it"
        )
    negative_count = 0
    for name, truth, image in zip(printed_names, truths, images, strict=True):
        check_light(truth.tolist(), f"{path}, gt of {name}")
        if not np.isfinite(image).all():
            raise FormatError(
                f"{path}: {name} has infinite or NaN pixels, expected finite values; set them to 0 to mask them"
            )
        negative_count += int((image < 0).sum())
    return SceneSet(
        name=Path(path).stem,
        layout="thumbnails",
        location=str(path),
        scenes=tuple(
            Thumbnail(name, truth, np.maximum(image, 0) if negative_count else image, saturation)
            for name, truth, image in zip(printed_names, truths, images, strict=True)
        ),
        treatment={
            "black level": "0: subtracted when the thumbnails were made"
            + (f"; {negative_count} negative values are set to 0" if negative_count else ""),
            "saturation": level_note(saturation, "none: clipping cannot be detected in averaged pixels"),
            "mask": "pixels that are zero in every channel",
            "ground truth": "gt of the archive",
        },
    )
