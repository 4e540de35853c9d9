"""The numbers that real and rendered images are told by, and the file in which those of a real data set are kept.

The numbers of one image are a function of its cells with the light divided out, so that a picture as the camera would
see it and a photograph of another camera are measured alike. `evaluate describe` makes the figures of a data set of
them and writes `STATS.json` (docs/formats.md), of which `generate --like` takes lights, sizes and numbers.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
import numpy.typing as npt

from foundation.colorimetry import angles_deg
from foundation.errors import FormatError

CELLS: Final = 64
"""Cells a side: the size of the thumbnails that colour constancy is learned from (FFCC, and the sets at hand)."""

LUMINANCE_PERCENTS: Final = (1, 5, 25, 50, 75, 95)
"""Percentiles of luminance, as shares of the 99th: the brightest percent is lamps and highlights."""

GREY_DEG: Final = 3.0
"""Degrees from white up to which a cell is near grey: about what a good method's median error is."""

DARK: Final = 0.001
"""Least luminance in a gradient, as a share of the 99th percentile: a logarithm needs one."""

LUMINANCE_EDGES: Final = tuple(float(edge) for edge in np.linspace(-3, 0.5, 71))
"""Edges of the luminance histogram: decimal logarithm of luminance over the 99th percentile."""

CHROMA_EDGES: Final = tuple(float(edge) for edge in np.linspace(-1.6, 1.6, 65))
"""Edges of the chroma histogram along ln(R/G) and ln(B/G); colours beyond are counted at the rim."""


def log_chroma(lights: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return ln(R/G) and ln(B/G) (N, 2) float64 of colours (N, 3) float above 0."""
    given = np.log(np.asarray(lights, dtype=np.float64))
    return given[:, [0, 2]] - given[:, 1:2]


def cell_borders(size: int, side: int = CELLS) -> npt.NDArray[np.int64]:
    """Return where cells begin along a side of `size` px, and where the last ends.

    `size`: of the image, px. Returns (N,) int64, px, from 0 to `size`, one more than cells.
    """
    count = min(side or size, size)
    return np.arange(count + 1, dtype=np.int64) * size // count


def cell_means(image: npt.NDArray[np.generic], light: npt.ArrayLike, side: int = CELLS) -> npt.NDArray[np.float64]:
    """Return an image of which every pixel is usable as cells (h, w, 3) float64, divided by its light.

    `image`: (H, W, 3) uint16 or float, linear camera RGB. `light`: (3,) float above 0, linear camera RGB of any length;
    its mean over the channels counts as 1.
    """
    rows, columns = (cell_borders(size, side) for size in image.shape[:2])
    # In float64, in which sums of 16-bit counts are exact up to 2⁵³.
    # By bands: `reduceat` across the rows of a whole image takes twelve times as long.
    bands = np.empty((len(rows) - 1, *image.shape[1:]))
    for band, (top, bottom) in zip(bands, pairwise(rows), strict=True):
        image[top:bottom].sum(axis=0, dtype=np.float64, out=band)
    sums = np.add.reduceat(bands, columns[:-1], axis=1)
    even = np.asarray(light, dtype=np.float64)
    return sums / (np.diff(rows)[:, None] * np.diff(columns))[..., None] / (even / even.mean())


def numbers_of_cells(
    colours: npt.NDArray[np.float64],
) -> tuple[dict[str, float], npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return what the cells of an image give.

    `colours`: (h, w, 3) float64, linear camera RGB divided by the light; NaN where a cell has no colour. Returns
    numbers by their names, NaN where one is not known: `luminance_1` … `luminance_95`, `edges`, `edges_95`,
    `chroma_spread`, `log_red_spread`, `log_blue_spread`, `near_grey`, `grey_red`, `grey_blue`; the histograms of
    luminance (70,) and of chroma (64, 64) float64, each of sum 1, all 0 of an image without a usable cell.
    """
    luminance = colours.mean(axis=2)
    known = luminance[np.isfinite(luminance)]
    white = percentile(known, 99)
    shares = known / white if white > 0 else np.empty(0)
    values = {f"luminance_{percent}": percentile(shares, percent) for percent in LUMINANCE_PERCENTS}
    edges = _edges(luminance, white)
    values["edges"] = float(edges.mean()) if edges.size else np.nan
    values["edges_95"] = percentile(edges, 95)
    with np.errstate(divide="ignore"):
        darkness = np.log10(np.maximum(shares, 0))
    counted = np.histogram(np.clip(darkness, LUMINANCE_EDGES[0], LUMINANCE_EDGES[-1]), LUMINANCE_EDGES)[0]
    chroma_values, chroma = _of_colours(colours[np.isfinite(luminance)])
    return values | chroma_values, counted / max(counted.sum(), 1), chroma


def percentile(values: npt.NDArray[np.float64], percent: float) -> float:
    """Return a percentile of values (N,) by MATLAB's definition; NaN of none."""
    return float(np.percentile(values, percent, method="hazen")) if values.size else np.nan


def _of_colours(colours: npt.NDArray[np.float64]) -> tuple[dict[str, float], npt.NDArray[np.float64]]:
    """Return the numbers that colours (N, 3) give, and the histogram of their chroma."""
    bins = len(CHROMA_EDGES) - 1
    lit = colours[(colours > 0).all(axis=1)]
    names = ("chroma_spread", "log_red_spread", "log_blue_spread", "near_grey", "grey_red", "grey_blue")
    if not len(lit):
        return dict.fromkeys(names, np.nan), np.zeros((bins, bins))
    places = log_chroma(lit)
    spread = float(np.sqrt((lit / lit.sum(axis=1, keepdims=True)).var(axis=0).mean()))
    near = float((angles_deg(lit, np.ones(3)) <= GREY_DEG).mean())
    red, blue = (float(number) for number in log_chroma(colours.mean(axis=0, keepdims=True))[0])
    kept = np.clip(places, CHROMA_EDGES[0], CHROMA_EDGES[-1])
    counted = np.histogram2d(kept[:, 0], kept[:, 1], (CHROMA_EDGES, CHROMA_EDGES))[0]
    numbers = (spread, *map(float, places.std(axis=0)), near, red, blue)
    return dict(zip(names, numbers, strict=True)), counted / len(lit)


def _edges(luminance: npt.NDArray[np.float64], white: float) -> npt.NDArray[np.float64]:
    """Return |difference of ln luminance| of all neighbours, side by side and one above the other."""
    if not white > 0:
        return np.empty(0)
    logarithm = np.log(np.maximum(luminance / white, DARK))
    steps = np.concatenate([np.abs(np.diff(logarithm, axis=axis)).ravel() for axis in (0, 1)])
    return steps[np.isfinite(steps)]


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
