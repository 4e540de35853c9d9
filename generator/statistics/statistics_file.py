"""`STATS.json`: what is known of a real data set, in the file that `evaluate describe --out` writes.

The generator takes from it what makes generated data like real ones: lights, sizes, and the numbers of each image. The
format is versioned and documented in docs/formats.md.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
import numpy.typing as npt

from foundation.errors import FormatError

FORMAT: Final = "crop.statistics"
"""What the file calls itself."""

VERSION: Final = 1
"""Of the format; raised when a reader of the version before would misread a file."""

_REMEDY: Final = "write it anew with evaluate describe DATA --out STATS.json"
_ENCODED: Final = 0.35
"""Median luminance, over the 99th percentile, from which a set's images may be encoded for a display. Of four sets of
real raw thumbnails the medians are .15 to .19 (NUS 600D and 1Ds Mark III, INTEL-TAU 5DSR prints and field); the sRGB
curve makes .42 to .48 of them."""


@dataclass(frozen=True, eq=False)
class RealStatistics:
    """What generated data are to be like.

    - `name`: of the data set.
    - `layout`: how it lies; ``"thumbnails"`` where its images were made small, so that their size says nothing.
    - `cells`: cells a side that its images were reduced to, at most; 0 if they were not.
    - `sizes`: width and height, px, with the number of images of that size, the most frequent first.
    - `images`: how many it has.
    - `lights`: (L, 3) float64 above 0, linear camera RGB with r + g + b = 1.
    - `values`: (images,) float64 each: numbers of the images by their names, as `image_numbers.numbers_of_cells` and
      `evaluate describe` call them; NaN where one is not known.
    - `file`, `sha256`: name of the file, and the hash of its bytes.
    """

    name: str
    layout: str
    cells: int
    sizes: tuple[tuple[int, int, int], ...]
    images: int
    lights: npt.NDArray[np.float64]
    values: Mapping[str, npt.NDArray[np.float64]]
    file: str
    sha256: str

    def known(self, name: str) -> npt.NDArray[np.float64]:
        """Return the numbers (M,) float64 of this name that are known; empty if none is."""
        given = self.values.get(name, np.empty(0))
        return given[np.isfinite(given)]

    @property
    def may_be_encoded(self) -> bool:
        """Whether the images are as bright in the middle as images for a display are, and raw ones are not."""
        middle = self.known("luminance_50")
        return bool(middle.size) and float(np.median(middle)) > _ENCODED


def read_content(path: Path | str) -> tuple[dict[str, Any], str]:
    """Return the JSON object of a `STATS.json` of a known version, and the SHA-256 of the file."""
    try:
        data = Path(path).read_bytes()
        content = json.loads(data.decode("utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise FormatError(f"{path} cannot be read as statistics: {error}; write one with evaluate describe") from error
    known = cast("dict[str, Any]", content if isinstance(content, dict) else {})
    if (known.get("format"), known.get("version")) != (FORMAT, VERSION):
        raise FormatError(
            f"{path} is of format {known.get('format')}, version {known.get('version')}; expected {FORMAT}, version "
            f"{VERSION}: {_REMEDY}"
        )
    return known, hashlib.sha256(data).hexdigest()


def lights_of(content: Mapping[str, Any]) -> npt.NDArray[np.float64]:
    """Return the lights (L, 3) float64 above 0 of a file's content."""
    lights = np.array(content["lights"], dtype=np.float64)
    if lights.ndim != 2 or lights.shape[1] != 3 or not (np.isfinite(lights) & (lights > 0)).all():
        raise ValueError(f"lights of shape {lights.shape}, expected (L, 3), all above 0")
    return lights


def read_lights(path: Path | str) -> npt.NDArray[np.float64]:
    """Return the lights (L, 3) float64 above 0, r + g + b = 1, of a `STATS.json`; all else of it may be missing."""
    content, _ = read_content(path)
    try:
        return lights_of(content)
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(f"{path} has no lights as its format has them: {error!r}; {_REMEDY}") from error


def read_statistics(path: Path | str) -> RealStatistics:
    """Return what a `STATS.json` says of a data set; what a later version adds is ignored."""
    content, sha256 = read_content(path)
    try:
        images = len(content["images"])
        values = {str(name): np.array(given, dtype=np.float64) for name, given in content["values"].items()}
        wrong = [name for name, given in values.items() if given.shape != (images,)]
        if wrong:
            raise ValueError(f"numbers of {images} images expected of {', '.join(wrong)}")
        return RealStatistics(
            name=str(content["data"]["name"]),
            layout=str(content["data"]["layout"]),
            cells=int(content["cells"]),
            sizes=tuple((int(size["width"]), int(size["height"]), int(size["images"])) for size in content["sizes"]),
            images=images,
            lights=lights_of(content),
            values=values,
            file=Path(path).name,
            sha256=sha256,
        )
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise FormatError(f"{path} is not as its format has it: {error!r}; {_REMEDY}") from error
