"""Masks: the weight of each of several illuminants in each pixel, computed or read from files.

A mask plan returns a mask maker for each image, and a maker returns the masks at any size. The weights of a pixel are
multiples of 1/65535 with sum 1, so that a 16-bit file stores them without loss. Computed masks follow these rules:

- They depend only on the seed and the number of the image (purpose 5 of `philox`).
- Lengths are relative to the longer side of the image. Masks with one seed and number look the same at every size, and
  an edge is never sharper than one pixel.
- Pixels are computed only with +, −, ×, ÷ and √, which IEEE 754 rounds equally everywhere. Masks therefore have the
  same bytes on every processor, except for the last bit of a few sines that place the shapes.
- Outside all discs or windows, the first illuminant has the weight 1.

docs/formats.md describes mask files. The largest number of the file format is weight 1, transparency is ignored, and
masks are resized to the image. Weights are divided by their sum. A pixel that is 0 in all K masks gets the first
illuminant.
"""

from __future__ import annotations

import hashlib
import logging
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any, Final, cast

import numpy as np
import numpy.typing as npt

from foundation.arrays import native
from foundation.compiled import compiled, inlined
from foundation.errors import FormatError, InputError, first_few, value_text
from foundation.names import in_natural_order
from generator import philox
from generator.files import read_native, require_plausible, upright
from generator.named_numbers import Range, parse_numbers

_log = logging.getLogger(__name__)

# The arrays are float32: numpy keeps this type if arrays are combined with Python numbers.
Array = npt.NDArray[np.floating[Any]]
_ZERO: Final = np.float32(0)
_HALF: Final = np.float32(0.5)
_ONE: Final = np.float32(1)
_THREE: Final = np.float32(3)
_STREAM_LENGTH: Final = 64  # Default number of random numbers of a stream; spots need up to 1 + 3 · 20
# Width of the bars between the panes of a window, relative to the window: 6 cm of 1 m, as in real windows.
_BAR: Final = 0.06

# Function from rows v (h, 1) to the shares (K, h, W) of K illuminants, which are weights before normalisation. v is the
# distance of a row from the image centre, relative to the longer side.
Shares = Callable[[Array], Array]


@dataclass(frozen=True)
class RandomStreams:
    """Uniform random numbers of one image, in independent streams."""

    seed: int
    number: int
    purpose: int = philox.MASKS

    def uniform(self, stream: int, count: int = _STREAM_LENGTH) -> npt.NDArray[np.float64]:
        """Return (count,) float64 between 0 and 1."""
        word = philox.words(self.seed, np.arange(count), stream, self.number, self.purpose)[0]
        return (word + 0.5) / (1 << 32)


@inlined
def stepped(x: Any) -> Any:
    """Return the cubic Hermite step of float32 x: 3x² − 2x³, 0 below 0 and 1 above 1."""
    x = min(max(x, _ZERO), _ONE)
    return x * x * (_THREE - x - x)


@dataclass(frozen=True)
class HalfPlanes:
    """Parallel strips, one for each illuminant; for two, half planes. A parameter that is None is random."""

    angle: float | None = None  # direction from the first illuminant to the last, degrees, clockwise from the right
    width: float | None = 0.0  # width of the soft edges; 0 for one pixel; None: random from 0.1 to 0.6

    def shares(self, streams: RandomStreams, half: tuple[float, float], lights: int, pixel: float, u: Array) -> Shares:
        """Return the function from rows v (h, 1) to the shares (K, h, W) float32 of the illuminants.

        All lengths are relative to the longer side. `half` is half the width and half the height of the image, `pixel`
        the size of a pixel. `u` (1, W) float32 are the distances of columns from the image centre.
        """
        drawn: list[float] = streams.uniform(0).tolist()
        angle = math.radians(360 * drawn[0] if self.angle is None else self.angle)
        width = max(0.1 + 0.5 * drawn[1] if self.width is None else self.width, pixel)
        reach = abs(math.cos(angle)) * half[0] + abs(math.sin(angle)) * half[1]
        edges = [reach * (2 * (edge + 0.6 * drawn[1 + edge] - 0.3) / lights - 1) for edge in range(1, lights)]

        right, down = np.float32(math.cos(angle)), np.float32(math.sin(angle))
        edge_places, soft = np.array(edges, np.float32), np.float32(width)

        def fill(v: Array) -> Array:
            strips = np.ones((lights, len(v), u.shape[1]), np.float32)
            _fill_strips(u[0], v[:, 0], right, down, edge_places, soft, strips)
            return strips

        return fill

    def describe(self) -> dict[str, Any]:
        """Return the shape as plain values."""
        return {"masks": "half-plane" if self.width == 0 else "soft-edge", "angle": self.angle, "width": self.width}


@dataclass(frozen=True)
class Spots:
    """Soft discs of every illuminant except the first."""

    count: int | None = None  # discs of each illuminant; None: random from 1 to 4
    radius: float | None = None  # radius at which the share is 0.5; None: random from 0.08 to 0.3
    softness: float = 0.8  # width of the edge relative to the radius, at most 2

    def shares(self, streams: RandomStreams, half: tuple[float, float], lights: int, pixel: float, u: Array) -> Shares:
        """Return the function from rows v (h, 1) to shares (K, h, W) float32; see `HalfPlanes.shares`."""
        discs: list[list[tuple[float, float, float, float]]] = []
        for light in range(1, lights):
            drawn = streams.uniform(light)
            count = 1 + int(4 * drawn[0]) if self.count is None else self.count
            discs.append([])
            for x, y, size in drawn[1 : 1 + 3 * count].reshape(-1, 3).tolist():
                radius = 0.08 + 0.22 * size if self.radius is None else self.radius
                centre = (half[0] * (2 * x - 1), half[1] * (2 * y - 1))
                edge = max(self.softness * radius, pixel)
                discs[-1].append((*centre, radius, edge))

        disc_arrays = [np.array(light, np.float32).reshape(-1, 4) for light in discs]

        def fill(v: Array) -> Array:
            shares = np.ones((lights, len(v), u.shape[1]), np.float32)
            for light, light_discs in enumerate(disc_arrays, start=1):
                _fill_discs(u[0], v[:, 0], light_discs, shares[light])
            return _with_first_light(shares)

        return fill

    def describe(self) -> dict[str, Any]:
        """Return the shape as plain values."""
        return {"masks": "spots", "count": self.count, "radius": self.radius, "softness": self.softness}


@dataclass(frozen=True)
class SmoothFields:
    """Smooth transitions: a random field for each illuminant from cubic B-splines (I. Schoenberg, 1946)."""

    scale: float = 0.5  # distance over which a field changes, relative to the longer side
    contrast: float = 2.0  # standard deviation of the fields; with large values, one illuminant dominates at each pixel

    def shares(self, streams: RandomStreams, half: tuple[float, float], lights: int, pixel: float, u: Array) -> Shares:
        """Return the function from rows v (h, 1) to shares (K, h, W) float32; see `HalfPlanes.shares`."""
        del half, pixel
        knots = math.ceil(2 / self.scale) + 4
        fields: list[Array] = []
        for light in range(lights):
            drawn = streams.uniform(light, knots * knots).reshape(knots, knots)
            # The spline multiplies the variance by 0.479 on average in each of two directions.
            field = (self.contrast / 0.479 * math.sqrt(12) * (drawn - 0.5)).astype(np.float32)
            fields.append(np.ascontiguousarray(self._splined(np.ascontiguousarray(field.T), u[0]).T))

        def fill(v: Array) -> Array:
            levels = np.stack([self._splined(field, v[:, 0]) for field in fields])
            _grow(levels.reshape(-1, u.shape[1]))
            return levels

        return fill

    def describe(self) -> dict[str, Any]:
        """Return the shape as plain values."""
        return {"masks": "smooth", "scale": self.scale, "contrast": self.contrast}

    def _splined(self, knots: Array, positions: Array) -> Array:
        # Interpolates `knots` (K, m) along the first axis at `positions` (n,) from −0.5 to 0.5; returns (n, m) float32.
        knot_positions = (positions + 0.5) * (2 / self.scale)
        first = np.floor(knot_positions)
        index = first.astype(np.intp)
        t = knot_positions - first
        s = 1 - t
        weights = (
            s * s * s / 6,
            (4 - 6 * t * t + 3 * t * t * t) / 6,
            (4 - 6 * s * s + 3 * s * s * s) / 6,
            t * t * t / 6,
        )
        total = np.zeros((len(positions), knots.shape[1]), np.float32)
        _add_splines(knots, index, np.stack(weights), total)
        return total


@dataclass(frozen=True)
class Windows:
    """Daylight through windows: panes in perspective, one window for each illuminant except the first."""

    columns: int | None = None  # columns of panes; None: 2 or 3
    rows: int | None = None  # rows of panes; None: 2 or 3
    softness: float | None = None  # width of the penumbra relative to the window; None: random from 0.02 to 0.1

    def shares(self, streams: RandomStreams, half: tuple[float, float], lights: int, pixel: float, u: Array) -> Shares:
        """Return the function from rows v (h, 1) to shares (K, h, W) float32; see `HalfPlanes.shares`."""
        windows = [self._window(streams.uniform(light), half, pixel) for light in range(1, lights)]

        def fill(v: Array) -> Array:
            shares = np.ones((lights, len(v), u.shape[1]), np.float32)
            for light, (matrix, columns, rows, soft) in enumerate(windows, start=1):
                x, y, w = (row[0] * u + row[1] * v + row[2] for row in matrix)
                # Behind the vanishing line the window is not visible.
                is_in_front = w > 1e-3
                w = np.where(is_in_front, w, 1)
                shares[light] = _panes(x / w, columns, soft) * _panes(y / w, rows, soft) * is_in_front
            return _with_first_light(shares)

        return fill

    def describe(self) -> dict[str, Any]:
        """Return the shape as plain values."""
        return {"masks": "window", "columns": self.columns, "rows": self.rows, "softness": self.softness}

    def _window(
        self, drawn: npt.NDArray[np.float64], half: tuple[float, float], pixel: float
    ) -> tuple[list[list[float]], int, int, float]:
        # Returns the homography from the image to the unit square of the window, the numbers of panes, and the
        # softness. `drawn` (64,) are uniform random numbers.
        size = 0.45 + 0.35 * drawn[0]
        shape = 0.7 + 0.7 * drawn[1]
        width, height = size * math.sqrt(shape), size / math.sqrt(shape)
        centre = np.array([half[0] * (drawn[2] - 0.5), half[1] * (drawn[3] - 0.5)])
        slant = 0.8 * (drawn[4] - 0.5)
        turn = math.radians(40 * (drawn[5] - 0.5))
        corners = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
        # One side of the window is farther away and therefore shorter.
        shortening = 1 - 0.4 * drawn[6:8] * np.sign(corners[:, ::-1] * (drawn[8:10] - 0.5)).clip(0)
        corners = corners * shortening * [width, height]
        corners[:, 0] += slant * corners[:, 1]
        rotation = np.array([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])
        matrix = _homography(corners @ rotation + centre)
        columns = self.columns or 2 + int(2 * drawn[10])
        rows = self.rows or 2 + int(2 * drawn[11])
        soft = 0.02 + 0.08 * float(drawn[12]) if self.softness is None else self.softness
        return matrix.tolist(), columns, rows, max(soft, pixel / float(min(width, height)))


# Shapes of computed masks.
Shape = HalfPlanes | Spots | SmoothFields | Windows


@compiled
def _fill_strips(u: Any, v: Any, right: Any, down: Any, edges: Any, width: Any, shares: Any) -> None:
    # Fills `shares` (K, n, m), initially 1, with strips between K − 1 soft edges.
    for y in range(len(v)):
        for edge in range(len(edges)):
            for x in range(len(u)):
                past = stepped((u[x] * right + v[y] * down - edges[edge]) / width + _HALF)
                shares[edge, y, x] -= past
                shares[edge + 1, y, x] = past


@compiled
def _fill_discs(u: Any, v: Any, discs: Any, light: Any) -> None:
    # Fills the shares of one illuminant (n, m), initially 1, with discs.
    for y in range(len(v)):
        for disc in range(len(discs)):
            x0, y0, radius, edge = discs[disc, 0], discs[disc, 1], discs[disc, 2], discs[disc, 3]
            for x in range(len(u)):
                distance = np.sqrt((u[x] - x0) * (u[x] - x0) + (v[y] - y0) * (v[y] - y0))
                light[y, x] *= stepped((distance - radius) / edge + _HALF)
        for x in range(len(u)):
            light[y, x] = _ONE - light[y, x]


@compiled
def _add_splines(knots: Any, index: Any, weights: Any, total: Any) -> None:
    # Adds four rows of `knots` from `index` (n,) on, times `weights` (4, n), to each row of `total` (n, m).
    for y in range(total.shape[0]):
        for step in range(4):
            weight, row = weights[step, y], index[y] + step
            for x in range(total.shape[1]):
                total[y, x] += weight * knots[row, x]


@compiled
def _grow(levels: Any) -> None:
    # Replaces x by (x + √(1 + x²))², which grows from 0 to ∞ like an exponential but needs only √.
    for y in range(levels.shape[0]):
        for x in range(levels.shape[1]):
            level = levels[y, x]
            root = np.sqrt(_ONE + level * level)
            grown = root + level if level >= _ZERO else _ONE / (root - level)
            levels[y, x] = grown * grown


def _homography(corners: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    # Maps four points (4, 2), clockwise, to the corners of the unit square.
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    rows: list[list[float]] = []
    for (u, v), (x, y) in zip(corners.tolist(), square.tolist(), strict=True):
        rows += [[u, v, 1.0, 0.0, 0.0, 0.0, -u * x, -v * x], [0.0, 0.0, 0.0, u, v, 1.0, -u * y, -v * y]]
    return np.append(np.linalg.solve(np.array(rows), square.reshape(-1)), 1.0).reshape(3, 3)


@compiled
def _add_panes(positions: Any, sides: Any, soft: Any, light: Any) -> None:
    for y in range(positions.shape[0]):
        for pane in range(sides.shape[0]):
            start, end = sides[pane, 0], sides[pane, 1]
            for x in range(positions.shape[1]):
                position = positions[y, x]
                light[y, x] += stepped((position - start) / soft + _HALF) - stepped((position - end) / soft + _HALF)
        for x in range(positions.shape[1]):
            light[y, x] = min(max(light[y, x], _ZERO), _ONE)


def _panes(positions: Array, count: int, soft: float) -> Array:
    # Transmission (n, m) of `count` panes at `positions` (n, m) from 0 to 1 across the window.
    sides = [
        (
            pane / count + (_BAR / 2 if pane else 0.0),
            (pane + 1) / count - (_BAR / 2 if pane < count - 1 else 0.0),
        )
        for pane in range(count)
    ]
    light = np.zeros_like(positions)
    _add_panes(positions, np.array(sides, np.float32), np.float32(soft), light)
    return light


def _with_first_light(shares: Array) -> Array:
    # Multiplies the shares of the first illuminant, initially 1, by 1 − share of each other illuminant, in place.
    for light in shares[1:]:
        shares[0] *= 1 - light
    return shares


FULL: Final = 65535  # Weight 1 in a 16-bit file

Weights = npt.NDArray[np.float32]  # (H, W, K) float32, 0 … 1: weight of each of K illuminants in each pixel, sum 1

_FULL: Final = np.float32(FULL)
_FULL_COUNT: Final = np.int32(FULL)


@compiled
def _quantise_shares_of_two(first: Any, second: Any, out: Any) -> None:
    # Does the same as `_quantise_shares` for two illuminants and `out` (H, 2 W), in a loop that the compiler
    # vectorises.
    for y in range(first.shape[0]):
        for x in range(first.shape[1]):
            total = first[y, x] + second[y, x]
            first_part = np.int32(first[y, x] / total * _FULL + _HALF)
            second_part = np.int32(second[y, x] / total * _FULL + _HALF)
            remainder, is_less = np.int32(_FULL_COUNT - first_part - second_part), np.int32(second[y, x] > first[y, x])
            out[y, 2 * x] = np.float32(np.int32(first_part + remainder * np.int32(1 - is_less))) / _FULL
            out[y, 2 * x + 1] = np.float32(np.int32(second_part + remainder * is_less)) / _FULL


@compiled
def _quantise_shares(shares: Any, out: Any) -> None:
    lights, rows, columns = shares.shape
    for y in range(rows):
        for x in range(columns):
            total = shares[0, y, x]
            largest = 0
            for light in range(1, lights):
                total += shares[light, y, x]
                if shares[light, y, x] > shares[largest, y, x]:
                    largest = light
            remainder = FULL
            for light in range(lights):
                quantised = np.int32(shares[light, y, x] / total * _FULL + _HALF)
                remainder -= quantised
                out[y, x, light] = np.float32(quantised) / _FULL
            quantised = np.int32(shares[largest, y, x] / total * _FULL + _HALF)
            out[y, x, largest] = np.float32(quantised + remainder) / _FULL


def quantise_shares(shares: npt.NDArray[np.floating[Any]], out: Weights) -> None:
    """Fill `out` (H, W, K) float32, contiguous, with normalised shares in multiples of 1/65535.

    `shares` is (K, H, W) float32 ≥ 0, not all 0 in a pixel. The largest share absorbs the rounding error.
    """
    if len(shares) == 2:
        _quantise_shares_of_two(shares[0], shares[1], out.reshape(len(out), -1))
    else:
        _quantise_shares(shares, out)


def checked_weights(weights: npt.ArrayLike, shape: tuple[int, int, int]) -> Weights:
    """Check weights (H, W, K) ≥ 0 from outside; return them normalised, in multiples of 1/65535."""
    try:
        given = native(weights)
    except (TypeError, ValueError) as error:
        raise InputError(f"the weights are no array: {error}; expected numbers of shape {shape}") from error
    if given.shape != shape or given.dtype.kind not in "fiub":
        raise InputError(
            f"the weights are {value_text(given)}, expected numbers of shape {shape}: height and width of the picture, "
            "and number of illuminants; correct them"
        )
    values = given.astype(np.float64)
    largest = values.max(axis=2, keepdims=True, initial=0)
    is_invalid = ~(np.isfinite(values) & (values >= 0)).all(axis=2) | (largest[..., 0] == 0)
    if is_invalid.any():
        row, column = np.argwhere(is_invalid)[0].tolist()
        raise InputError(
            f"the weights in row {row}, column {column} are {given[row, column].tolist()}, expected finite numbers ≥ 0 "
            f"with a sum above 0; correct {np.count_nonzero(is_invalid)} of {is_invalid.size} pixels"
        )
    normalised = np.empty(shape, np.float32)
    # Weights are first divided by the largest one, because the sum of very large weights would be infinite.
    quantise_shares(np.ascontiguousarray((values / largest).transpose(2, 0, 1), np.float32), normalised)
    return normalised


def decode_values(file: bytes, name: Path | str) -> npt.NDArray[Any]:
    """Return the values (H, W) or (H, W, 3), RGB without transparency, uint8, uint16 or float32 as stored."""
    import cv2

    require_plausible(file, str(name))
    data = np.frombuffer(file, np.uint8)
    image = cast("npt.NDArray[Any] | None", cv2.imdecode(data, cv2.IMREAD_UNCHANGED)) if data.size else None
    if image is None or image.ndim not in (2, 3):
        raise FormatError(f"{name} cannot be read as an image, expected PNG or TIFF; replace it")
    if image.ndim == 2:
        return image
    return image[..., 0] if image.shape[2] < 3 else image[..., 2::-1]


# File name suffixes of masks.
SUFFIXES: Final = (".png", ".tif", ".tiff", ".jpg", ".jpeg", ".bmp", ".webp", ".pgm", ".ppm")

_Array = npt.NDArray[np.float32]


@dataclass(frozen=True)
class GivenMasks:
    """The masks of one image, from files."""

    files: tuple[Path, ...]

    def weights(self, height: int, width: int, lights: int) -> Weights:
        """Return the weights (height, width, lights) float32, in multiples of 1/65535, sum 1 in every pixel."""
        masks = [_resized(mask, height, width) for file in self.files for mask in _read(file)]
        names = ", ".join(file.name for file in self.files)
        if len(masks) not in (lights, lights - 1):
            raise FormatError(
                f"{names} in {self.files[0].parent} have {len(masks)} masks, expected {lights} for {lights} "
                f"illuminants, or {lights - 1} without the first; add or remove masks"
            )
        total = np.sum(masks, axis=0, dtype=np.float32)
        if len(masks) == lights:
            masks[0] = np.where(total > 0, masks[0], 1)
            shares = np.stack(masks)
        else:
            divisor = np.maximum(total, 1)
            shares = np.stack([np.maximum(1 - total, 0), *(mask / divisor for mask in masks)])
        out = np.empty((height, width, lights), np.float32)
        quantise_shares(shares, out)
        return out


@dataclass(frozen=True)
class GivenMaskPlan:
    """Sets of mask files, used for one image after another and repeated if there are too few."""

    folder: str  # name of the folder
    sets: tuple[GivenMasks, ...]  # in the natural order of their names
    names: tuple[str, ...]  # name of each set: that of its files without number and suffix
    sha256: str  # hash of the names and bytes of all files in this order
    # Index of the set by image number, if the file names have image numbers; else empty, and sets are used in turn.
    set_of_image: Mapping[int, int] = field(default_factory=dict[int, int])
    set_of_picture: tuple[int, ...] = ()  # index of the set of each picture if both have the same names, else empty
    images_each: int = 1  # images of each picture

    def maker(self, number: int) -> GivenMasks:
        """Return the masks of image `number`."""
        if self.set_of_picture:
            return self.sets[self.set_of_picture[number // self.images_each]]
        return self.sets[self.set_of_image.get(number, number % len(self.sets))]

    def describe(self) -> dict[str, Any]:
        """Return the plan as plain values."""
        described = {"masks": "files", "folder": self.folder, "sets": len(self.sets), "sha256": self.sha256}
        return {**described, "pairing": "names"} if self.set_of_picture else described

    def paired(self, pictures: Sequence[str], images_each: int) -> GivenMaskPlan:
        """Return the plan with the sets assigned to pictures by name.

        If no set has the name of a picture, the sets are used in turn. Raises InputError if only some pictures have a
        set. `pictures`: names of all pictures, with folders and suffixes. `images_each`: images of each picture.
        """
        indices = {name: index for index, name in enumerate(self.names)}
        stems = [PurePosixPath(picture).stem for picture in pictures]
        missing = [picture for picture, stem in zip(pictures, stems, strict=True) if stem not in indices]
        if missing and len(missing) < len(pictures) and not self.set_of_image:
            raise InputError(
                f"{self.folder} has masks for {len(pictures) - len(missing)} of {len(pictures)} pictures by name, but "
                f"not for {first_few(missing)}; add masks named like them, or rename all masks"
            )
        plan = self if missing else replace(self, set_of_picture=tuple(map(indices.__getitem__, stems)))
        plan = replace(plan, images_each=images_each)
        for position, picture in enumerate(pictures if _log.isEnabledFor(logging.INFO) else ()):
            _log.info(
                "%s: masks %s", picture, ", ".join(file.name for file in plan.maker(position * images_each).files)
            )
        return plan


def find_masks(folder: Path, lights: int) -> GivenMaskPlan:
    """Return the sets of masks in a folder; docs/formats.md describes their names."""
    try:
        files = sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES and path.is_file())
    except OSError as error:
        raise FormatError(f"cannot list the masks of {folder}: {error.strerror}; give a folder of masks") from error
    groups: dict[str, list[tuple[int, Path]]] = {}
    for path in files:
        # Up to three digits are the number of a mask. Four or more are a file number of a camera.
        match = re.fullmatch(r"(.+)_(\d{1,3})", path.stem)
        name, number = (f"{match[1]}_", int(match[2])) if match else (path.stem, 0)
        groups.setdefault(name, []).append((number, path))
    if not groups:
        raise FormatError(f"{folder} has no masks, expected images such as NAME_1.png, NAME_2.png; give another folder")
    digest = hashlib.sha256()
    sets: list[GivenMasks] = []
    names = in_natural_order(groups)
    for name in names:
        members = tuple(path for _, path in sorted(groups[name]))
        for path in members:
            digest.update(f"{path.name}\n".encode())
            digest.update(_bytes_of(path))
        masks = GivenMasks(members)
        masks.weights(2, 2, lights)
        sets.append(masks)
    keys = [re.fullmatch(r"(\d{6,})_", name) for name in names]
    numbered = {int(key[1]): index for index, key in enumerate(keys) if key}
    set_of_image = numbered if len(numbered) == len(sets) else {}
    set_names = tuple(name.removesuffix("_") for name in names)
    return GivenMaskPlan(folder.name, tuple(sets), set_names, digest.hexdigest(), set_of_image)


def _bytes_of(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise FormatError(f"cannot read the mask {path}: {error.strerror}; replace it") from error


def _read(path: Path) -> list[_Array]:
    # Returns the masks (H, W) float32, 0 … 1, of a file: one if it has one channel or equal channels, otherwise three.
    # They are turned upright like pictures.
    require_plausible(_bytes_of(path), str(path))
    try:
        stored = read_native(path)
    except ValueError as error:
        raise FormatError(f"{path} cannot be read: {' '.join(str(error).split())}; replace it") from error
    colours = [channel for channel in range(stored.values.shape[2]) if channel != stored.alpha][:3]
    image = upright(stored.values[..., colours if len(colours) == 3 else colours[:1]], stored.orientation)
    if image.dtype.kind == "u" and image.dtype.itemsize <= 2:
        scaled = np.asarray(image / np.float32(np.iinfo(image.dtype).max), dtype=np.float32)
    elif image.dtype.kind == "f" and np.isfinite(image).all():
        scaled = np.clip(image, 0, 1).astype(np.float32)
    else:
        raise FormatError(f"{path} has {image.dtype} or non-finite values, expected 8 or 16 bits; convert it")
    is_grey = bool((scaled == scaled[..., :1]).all())
    return [np.ascontiguousarray(scaled[..., channel]) for channel in range(1 if is_grey else scaled.shape[2])]


def _resized(mask: _Array, height: int, width: int) -> _Array:
    # Masks are reduced by averaging over areas, and enlarged by linear interpolation.
    import cv2

    if mask.shape == (height, width):
        return mask
    is_smaller = height <= mask.shape[0] and width <= mask.shape[1]
    interpolation = cv2.INTER_AREA if is_smaller else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(mask, (width, height), interpolation=interpolation), dtype=np.float32)


# Pixels computed at once; intermediate float32 arrays of this size stay in the cache of the processor.
_PIXELS: Final = 1 << 15


@dataclass(frozen=True)
class MadeMasks:
    """The computed masks of one image."""

    shape: Shape
    streams: RandomStreams

    def weights(self, height: int, width: int, lights: int) -> Weights:
        """Return the weights (height, width, lights) float32, in multiples of 1/65535, sum 1 in every pixel."""
        longer = max(height, width)
        u = ((np.arange(width) - (width - 1) / 2) / longer).astype(np.float32)[None, :]
        v = ((np.arange(height) - (height - 1) / 2) / longer).astype(np.float32)[:, None]
        shares = self.shape.shares(self.streams, (width / longer / 2, height / longer / 2), lights, 1 / longer, u)
        out = np.empty((height, width, lights), np.float32)
        rows = max(1, _PIXELS // width)
        for top in range(0, height, rows):
            quantise_shares(shares(v[top : top + rows]), out[top : top + rows])
        return out


@dataclass(frozen=True)
class MadeMaskPlan:
    """Computed masks of one shape, different in each image."""

    shape: Shape
    seed: int

    def maker(self, number: int) -> MadeMasks:
        """Return the masks of image `number`."""
        return MadeMasks(self.shape, RandomStreams(self.seed, number))

    def describe(self) -> dict[str, Any]:
        """Return the plan as plain values."""
        return self.shape.describe()


MaskMaker = GivenMasks | MadeMasks  # Masks of one image

MaskPlan = GivenMaskPlan | MadeMaskPlan  # Masks of all images of a data set

# Smallest and largest value of each number of a shape.
_SHARE: Range = (0.0, 1.0)
_OPTIONS: Final[dict[str, dict[str, Range]]] = {
    "half-plane": {"angle": (-360.0, 360.0), "width": _SHARE},
    "soft-edge": {"angle": (-360.0, 360.0), "width": _SHARE},
    "spots": {"count": (1.0, 20.0), "radius": (0.01, 1.0), "softness": (0.0, 2.0)},
    "smooth": {"scale": (0.02, 2.0), "contrast": (0.0, 100.0)},
    "window": {"columns": (1.0, 20.0), "rows": (1.0, 20.0), "softness": _SHARE},
}


def parse_masks(text: str, lights: int, seed: int) -> MaskPlan:
    """Return the masks that a text specifies.

    The text is a shape with optional numbers, such as ``half-plane``, ``soft-edge:angle=30,width=0.2``,
    ``spots:count=3,radius=0.1,softness=0.5``, ``smooth:scale=0.3,contrast=8`` or
    ``window:columns=2,rows=3,softness=0.05``. Any other text is a folder for `find_masks`.
    """
    if text.strip().partition(":")[0] not in _OPTIONS:
        if not text.strip() or not Path(text).is_dir():
            raise InputError(f"{text!r} is not a folder of masks; give one, or a shape: {', '.join(_OPTIONS)}")
        return find_masks(Path(text).absolute(), lights)
    return MadeMaskPlan(parse_shape(text), seed)


def parse_shape(text: str) -> Shape:
    """Return the shape of computed masks that a text specifies; see `parse_masks`."""
    name, _, rest = text.strip().partition(":")
    if name not in _OPTIONS:
        raise InputError(f"{name!r} is not a shape of masks, expected one of {', '.join(_OPTIONS)}; correct it")
    numbers = parse_numbers(rest, _OPTIONS[name], f"the masks {name}")
    counts = {key: _integer(numbers[key], key, name) for key in ("count", "columns", "rows") if key in numbers}
    match name:
        case "half-plane" | "soft-edge":
            width = numbers.get("width", 0.0 if name == "half-plane" else None)
            return HalfPlanes(numbers.get("angle"), width)
        case "spots":
            return Spots(counts.get("count"), numbers.get("radius"), numbers.get("softness", Spots.softness))
        case "smooth":
            return SmoothFields(
                numbers.get("scale", SmoothFields.scale), numbers.get("contrast", SmoothFields.contrast)
            )
        case _:
            return Windows(counts.get("columns"), counts.get("rows"), numbers.get("softness"))


def _integer(number: float, name: str, shape_name: str) -> int:
    if number != int(number):
        raise InputError(f"{name}={number:g} of the masks {shape_name} is invalid, expected an integer; correct it")
    return int(number)
