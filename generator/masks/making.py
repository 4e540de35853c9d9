"""Where each of several lights falls on an image: masks that are computed, or that a user gives as files.

A plan makes the masks of image after image; a maker makes those of one image at any size. The weights of a pixel are
whole 65535ths that sum to 1, so that a 16-bit file holds them without loss. Rules that hold for what is computed:

- Lengths are shares of the picture's longer side, and noise has its place in the picture and not in a pixel. So the
  masks of one seed and number look the same at every size; an edge is never sharper than one pixel.
- What is made depends on the seed and the image's number alone; purpose 5 of `philox`.
- Every pixel is computed with +, −, ×, ÷ and √ alone, which IEEE 754 rounds alike everywhere. So the same masks are
  the same bytes on every processor, up to the last bit of the few sines that place the shapes.

A shape draws its places from an image's streams, and gives a function from places in the picture to the lights'
shares. The first light is the one that falls where no shape is.

docs/formats.md says which files are masks in a folder. Full scale is weight 1; 8 or 16 bits, or float from 0 to 1;
transparency does not count. A set of any size is made to fit the image. Weights are divided by their sum. Where K masks
leave a pixel dark, the first light falls.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
import numpy.typing as npt

from foundation.compiled import compiled, inlined
from foundation.errors import FormatError, InputError
from generator import philox
from generator.files import require_plausible
from generator.named_numbers import Range, parse_numbers

# float32: what is computed from float32 arrays and Python's own numbers stays float32.
Array = npt.NDArray[np.floating[Any]]
_ZERO: Final = np.float32(0)
_HALF: Final = np.float32(0.5)
_ONE: Final = np.float32(1)
_THREE: Final = np.float32(3)
_STEP: Final = 64  # Numbers of one stream: as many as the largest shape draws, 1 + 3 · 20 of the spots, and some
# Breadth of the bars between a window's panes, as a share of the window: 6 cm of a metre, as glazing bars are.
_BAR: Final = 0.06

# From v (h, 1), rows' distances from the picture's centre, shares of its longer side, to lights' shares (K, h, W).
Shares = Callable[[Array], Array]


@dataclass(frozen=True)
class RandomStreams:
    """Uniform random numbers of one image; each `stream` of them is independent of the others, and each purpose."""

    seed: int
    number: int
    purpose: int = philox.MASKS

    def uniform(self, stream: int, count: int = _STEP) -> npt.NDArray[np.float64]:
        """Return (count,) float64 between 0 and 1."""
        word = philox.words(self.seed, np.arange(count), stream, self.number, self.purpose)[0]
        return (word + 0.5) / (1 << 32)


@inlined
def stepped(x: Any) -> Any:
    """Return for float32 x 0 below 0, 1 above 1, and 3x² − 2x³ between (the cubic Hermite step)."""
    x = min(max(x, _ZERO), _ONE)
    return x * x * (_THREE - x - x)


@dataclass(frozen=True)
class HalfPlanes:
    """Parallel strips, one for each light: for two lights a half plane each.

    - `angle`: direction in degrees from the first light to the last, clockwise from the right; None: any.
    - `width`: breadth of the soft edge; 0 is as sharp as pixels allow. None: any from 0.1 to 0.6.
    """

    angle: float | None = None
    width: float | None = 0.0

    def shares(self, streams: RandomStreams, half: tuple[float, float], lights: int, pixel: float, u: Array) -> Shares:
        """Return the function from rows v (h, 1) to the lights' shares (K, h, W) float32 of their pixels.

        `pixel`: size of a pixel, a share of the longer side. `u`: (1, W) float32, the columns' distances from the
        picture's centre, shares of the longer side.
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
        """Return the kind and its numbers."""
        return {"masks": "half-plane" if self.width == 0 else "soft-edge", "angle": self.angle, "width": self.width}


@dataclass(frozen=True)
class Spots:
    """Soft discs of every light but the first.

    - `count`: discs of each light; None: any from 1 to 4.
    - `radius`: where a disc's light has fallen to a half; None: any from 0.08 to 0.3.
    - `softness`: breadth of the edge over the radius, up to 2.
    """

    count: int | None = None
    radius: float | None = None
    softness: float = 0.8

    def shares(self, streams: RandomStreams, half: tuple[float, float], lights: int, pixel: float, u: Array) -> Shares:
        """Return the function from rows v (h, 1) to shares (K, h, W) float32; see `HalfPlanes.shares`."""
        discs: list[list[tuple[float, float, float, float]]] = []
        for light in range(1, lights):
            drawn = streams.uniform(light)
            count = 1 + int(4 * drawn[0]) if self.count is None else self.count
            discs.append([])
            for x, y, size in drawn[1 : 1 + 3 * count].reshape(-1, 3).tolist():
                radius = 0.08 + 0.22 * size if self.radius is None else self.radius
                place = (half[0] * (2 * x - 1), half[1] * (2 * y - 1))
                edge = max(self.softness * radius, pixel)
                discs[-1].append((*place, radius, edge))

        places = [np.array(light, np.float32).reshape(-1, 4) for light in discs]

        def fill(v: Array) -> Array:
            shares = np.ones((lights, len(v), u.shape[1]), np.float32)
            for light, its in enumerate(places, start=1):
                _fill_discs(u[0], v[:, 0], its, shares[light])
            return _over_the_first(shares)

        return fill

    def describe(self) -> dict[str, Any]:
        """Return the kind and its numbers."""
        return {"masks": "spots", "count": self.count, "radius": self.radius, "softness": self.softness}


@dataclass(frozen=True)
class SmoothFields:
    """Lights that pass into one another: a random field for each, smoothed by cubic B-splines (I. Schoenberg, 1946).

    - `scale`: distance over which a field changes, a share of the longer side.
    - `contrast`: how much one light prevails where its field is largest.
    """

    scale: float = 0.5
    contrast: float = 2.0

    def shares(self, streams: RandomStreams, half: tuple[float, float], lights: int, pixel: float, u: Array) -> Shares:
        """Return the function from rows v (h, 1) to shares (K, h, W) float32; see `HalfPlanes.shares`."""
        del half, pixel
        knots = math.ceil(2 / self.scale) + 4
        fields: list[Array] = []
        for light in range(lights):
            drawn = streams.uniform(light, knots * knots).reshape(knots, knots)
            # The spline leaves 0.479 of the knots' variance in each direction, on the average.
            field = (self.contrast / 0.479 * math.sqrt(12) * (drawn - 0.5)).astype(np.float32)
            fields.append(np.ascontiguousarray(self._splined(np.ascontiguousarray(field.T), u[0]).T))

        def fill(v: Array) -> Array:
            levels = np.stack([self._splined(field, v[:, 0]) for field in fields])
            _grow(levels.reshape(-1, u.shape[1]))
            return levels

        return fill

    def describe(self) -> dict[str, Any]:
        """Return the kind and its numbers."""
        return {"masks": "smooth", "scale": self.scale, "contrast": self.contrast}

    def _splined(self, knots: Array, at: Array) -> Array:
        """Return (n, m) float32 for `knots` (K, m), whose first index runs over places `at` (n,) from −0.5 to 0.5."""
        place = (at + 0.5) * (2 / self.scale)
        first = np.floor(place)
        index = first.astype(np.intp)
        t = place - first
        s = 1 - t
        weights = (
            s * s * s / 6,
            (4 - 6 * t * t + 3 * t * t * t) / 6,
            (4 - 6 * s * s + 3 * s * s * s) / 6,
            t * t * t / 6,
        )
        total = np.zeros((len(at), knots.shape[1]), np.float32)
        _add_splines(knots, index, np.stack(weights), total)
        return total


@dataclass(frozen=True)
class Windows:
    """Daylight through a window on wall or floor: panes in perspective, a window for each light but the first.

    - `columns`, `rows`: panes across and down; None: 2 or 3.
    - `softness`: breadth of the half shadow, a share of the window; None: any from 0.02 to 0.1.
    """

    columns: int | None = None
    rows: int | None = None
    softness: float | None = None

    def shares(self, streams: RandomStreams, half: tuple[float, float], lights: int, pixel: float, u: Array) -> Shares:
        """Return the function from rows v (h, 1) to shares (K, h, W) float32; see `HalfPlanes.shares`."""
        windows = [self._window(streams.uniform(light), half, pixel) for light in range(1, lights)]

        def fill(v: Array) -> Array:
            shares = np.ones((lights, len(v), u.shape[1]), np.float32)
            for light, (matrix, columns, rows, soft) in enumerate(windows, start=1):
                x, y, w = (row[0] * u + row[1] * v + row[2] for row in matrix)
                # Behind the vanishing line there is no window.
                seen = w > 1e-3
                w = np.where(seen, w, 1)
                shares[light] = _panes(x / w, columns, soft) * _panes(y / w, rows, soft) * seen
            return _over_the_first(shares)

        return fill

    def describe(self) -> dict[str, Any]:
        """Return the kind and its numbers."""
        return {"masks": "window", "columns": self.columns, "rows": self.rows, "softness": self.softness}

    def _window(
        self, drawn: npt.NDArray[np.float64], half: tuple[float, float], pixel: float
    ) -> tuple[list[list[float]], int, int, float]:
        """Return the homography (3, 3) from the picture to the window's unit square, its panes, and its softness.

        `drawn` (64,) float64 are random numbers between 0 and 1.
        """
        size = 0.45 + 0.35 * drawn[0]
        shape = 0.7 + 0.7 * drawn[1]
        width, height = size * math.sqrt(shape), size / math.sqrt(shape)
        centre = np.array([half[0] * (drawn[2] - 0.5), half[1] * (drawn[3] - 0.5)])
        slant = 0.8 * (drawn[4] - 0.5)
        turn = math.radians(40 * (drawn[5] - 0.5))
        corners = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
        # One side of the window is farther away, hence shorter.
        far = 1 - 0.4 * drawn[6:8] * np.sign(corners[:, ::-1] * (drawn[8:10] - 0.5)).clip(0)
        corners = corners * far * [width, height]
        corners[:, 0] += slant * corners[:, 1]
        rotation = np.array([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])
        matrix = _homography(corners @ rotation + centre)
        columns = self.columns or 2 + int(2 * drawn[10])
        rows = self.rows or 2 + int(2 * drawn[11])
        soft = 0.02 + 0.08 * float(drawn[12]) if self.softness is None else self.softness
        return matrix.tolist(), columns, rows, max(soft, pixel / float(min(width, height)))


# A kind of masks: from the streams of an image to where its lights fall.
Shape = HalfPlanes | Spots | SmoothFields | Windows


@compiled
def _fill_strips(u: Any, v: Any, right: Any, down: Any, edges: Any, width: Any, shares: Any) -> None:
    """Fill the lights' shares (K, n, m), all 1, with strips between K − 1 soft edges."""
    for y in range(len(v)):
        for edge in range(len(edges)):
            for x in range(len(u)):
                past = stepped((u[x] * right + v[y] * down - edges[edge]) / width + _HALF)
                shares[edge, y, x] -= past
                shares[edge + 1, y, x] = past


@compiled
def _fill_discs(u: Any, v: Any, discs: Any, light: Any) -> None:
    """Fill a light's shares (n, m), all 1, with discs."""
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
    """Add to each row of `total` (n, m) four rows of `knots`, from that of `index` (n,) on, times `weights` (4, n)."""
    for y in range(total.shape[0]):
        for step in range(4):
            weight, row = weights[step, y], index[y] + step
            for x in range(total.shape[1]):
                total[y, x] += weight * knots[row, x]


@compiled
def _grow(levels: Any) -> None:
    """Replace float32 x in `levels` (n, m) by (x + √(1 + x²))²: it grows from 0 to ∞ as an exponential, of √ alone."""
    for y in range(levels.shape[0]):
        for x in range(levels.shape[1]):
            level = levels[y, x]
            root = np.sqrt(_ONE + level * level)
            grown = root + level if level >= _ZERO else _ONE / (root - level)
            levels[y, x] = grown * grown


def _homography(corners: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the homography (3, 3) float64 from four places (4, 2), clockwise, to the corners of the unit square."""
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    rows: list[list[float]] = []
    for (u, v), (x, y) in zip(corners.tolist(), square.tolist(), strict=True):
        rows += [[u, v, 1.0, 0.0, 0.0, 0.0, -u * x, -v * x], [0.0, 0.0, 0.0, u, v, 1.0, -u * y, -v * y]]
    return np.append(np.linalg.solve(np.array(rows), square.reshape(-1)), 1.0).reshape(3, 3)


@compiled
def _add_panes(at: Any, sides: Any, soft: Any, light: Any) -> None:
    """Add to `light` (n, m) float32 the panes between `sides` (P, 2) at places `at` (n, m), and clip it to 0 … 1."""
    for y in range(at.shape[0]):
        for pane in range(sides.shape[0]):
            left, right = sides[pane, 0], sides[pane, 1]
            for x in range(at.shape[1]):
                light[y, x] += stepped((at[y, x] - left) / soft + _HALF) - stepped((at[y, x] - right) / soft + _HALF)
        for x in range(at.shape[1]):
            light[y, x] = min(max(light[y, x], _ZERO), _ONE)


def _panes(at: Array, count: int, soft: float) -> Array:
    """Return the light (n, m) float32 through `count` panes at places `at` (n, m) float32, 0 … 1 across the window."""
    sides = [
        (
            pane / count + (_BAR / 2 if pane else 0.0),
            (pane + 1) / count - (_BAR / 2 if pane < count - 1 else 0.0),
        )
        for pane in range(count)
    ]
    light = np.zeros_like(at)
    _add_panes(at, np.array(sides, np.float32), np.float32(soft), light)
    return light


def _over_the_first(shares: Array) -> Array:
    """Return the lights' shares (K, h, W) float32, in place: the first light's, all 1, times what the others leave."""
    for light in shares[1:]:
        shares[0] *= 1 - light
    return shares


FULL: Final = 65535  # Weight 1 as a 16-bit file holds it: the largest value of 16 bits

Weights = npt.NDArray[np.float32]  # (H, W, K) float32, 0 … 1: the weight of each of K lights in each pixel; sum 1

_FULL: Final = np.float32(FULL)
_WHOLE: Final = np.int32(FULL)


@compiled
def _quantise_shares_of_two(first: Any, second: Any, out: Any) -> None:
    """Do as `_quantise_shares` for two lights and `out` (H, 2 W) float32, in a loop that the compiler vectorises."""
    for y in range(first.shape[0]):
        for x in range(first.shape[1]):
            total = first[y, x] + second[y, x]
            one = np.int32(first[y, x] / total * _FULL + _HALF)
            other = np.int32(second[y, x] / total * _FULL + _HALF)
            left, is_less = np.int32(_WHOLE - one - other), np.int32(second[y, x] > first[y, x])
            out[y, 2 * x] = np.float32(np.int32(one + left * np.int32(1 - is_less))) / _FULL
            out[y, 2 * x + 1] = np.float32(np.int32(other + left * is_less)) / _FULL


@compiled
def _quantise_shares(shares: Any, out: Any) -> None:
    """Fill `out` (H, W, K) float32 with `shares` (K, H, W) float32 as `quantise_shares` does."""
    lights, rows, columns = shares.shape
    for y in range(rows):
        for x in range(columns):
            total = shares[0, y, x]
            largest = 0
            for light in range(1, lights):
                total += shares[light, y, x]
                if shares[light, y, x] > shares[largest, y, x]:
                    largest = light
            left = FULL
            for light in range(lights):
                part = np.int32(shares[light, y, x] / total * _FULL + _HALF)
                left -= part
                out[y, x, light] = np.float32(part) / _FULL
            part = np.int32(shares[largest, y, x] / total * _FULL + _HALF)
            out[y, x, largest] = np.float32(part + left) / _FULL


def quantise_shares(shares: npt.NDArray[np.floating[Any]], out: Weights) -> None:
    """Fill `out` with shares in whole 65535ths that sum to 1; the largest takes up the rounding error.

    `shares`: (K, H, W) float32 ≥ 0, not all 0 in a pixel. `out`: (H, W, K) float32, 0 to 1, contiguous.
    """
    if len(shares) == 2:
        _quantise_shares_of_two(shares[0], shares[1], out.reshape(len(out), -1))
    else:
        _quantise_shares(shares, out)


def decode_values(file: bytes, what: Path | str) -> npt.NDArray[Any]:
    """Return the values (H, W) or (H, W, 3), RGB, of the file's dtype (uint8, uint16, float32), no transparency."""
    import cv2

    require_plausible(file, str(what))
    data = np.frombuffer(file, np.uint8)
    image = cast("npt.NDArray[Any] | None", cv2.imdecode(data, cv2.IMREAD_UNCHANGED)) if data.size else None
    if image is None or image.ndim not in (2, 3):
        raise FormatError(f"{what} is no picture that can be read, or damaged; give masks as PNG or TIFF")
    if image.ndim == 2:
        return image
    return image[..., 0] if image.shape[2] < 3 else image[..., 2::-1]


# Endings of what is taken for a mask.
SUFFIXES: Final = (".png", ".tif", ".tiff", ".jpg", ".jpeg", ".bmp", ".webp", ".pgm", ".ppm")

_Array = npt.NDArray[np.float32]


@dataclass(frozen=True)
class GivenMasks:
    """The masks of one image, from files."""

    files: tuple[Path, ...]

    def weights(self, height: int, width: int, lights: int) -> Weights:
        """Return (height, width, lights) float32 from 0 to 1 in whole 65535ths that sum to 1 in every pixel."""
        masks = [_fitted(mask, height, width) for file in self.files for mask in _read(file)]
        names = ", ".join(file.name for file in self.files)
        if len(masks) not in (lights, lights - 1):
            raise FormatError(
                f"{names} in {self.files[0].parent}: {lights} lights need {lights} masks, or {lights - 1} for those "
                f"after the first; found {len(masks)}"
            )
        total = np.sum(masks, axis=0, dtype=np.float32)
        if len(masks) == lights:
            masks[0] = np.where(total > 0, masks[0], 1)
            shares = np.stack(masks)
        else:
            over = np.maximum(total, 1)
            shares = np.stack([np.maximum(1 - total, 0), *(mask / over for mask in masks)])
        out = np.empty((height, width, lights), np.float32)
        quantise_shares(shares, out)
        return out


@dataclass(frozen=True)
class GivenMaskPlan:
    """Sets of mask files for one image after another, starting over when they end.

    - `folder`: name of the folder.
    - `sets`: in the order of their names.
    - `sha256`: over the names and bytes of all files in their order.
    - `places`: which set belongs to the image of a number; empty where all are taken in turn.
    """

    folder: str
    sets: tuple[GivenMasks, ...]
    sha256: str
    places: Mapping[int, int] = field(default_factory=dict[int, int])

    def maker(self, number: int) -> GivenMasks:
        """Return the masks of image `number`."""
        return self.sets[self.places.get(number, number % len(self.sets))]

    def describe(self) -> dict[str, Any]:
        """Return the plan as plain values."""
        return {"masks": "files", "folder": self.folder, "sets": len(self.sets), "sha256": self.sha256}


def find_masks(folder: Path, lights: int) -> GivenMaskPlan:
    """Return the sets of masks in a folder; docs/formats.md has the rules."""
    try:
        files = sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES and path.is_file())
    except OSError as error:
        raise FormatError(f"cannot list the masks of {folder}: {error.strerror}; name a folder of masks") from error
    groups: dict[str, list[tuple[int, Path]]] = {}
    for path in files:
        # Cameras count their files with four digits or more.
        match = re.fullmatch(r"(.+)_(\d{1,3})", path.stem)
        name, number = (f"{match[1]}_", int(match[2])) if match else (path.stem, 0)
        groups.setdefault(name, []).append((number, path))
    if not groups:
        raise FormatError(f"there is no mask in {folder}; expected images such as NAME_1.png, NAME_2.png, a light each")
    digest = hashlib.sha256()
    sets: list[GivenMasks] = []
    for name in sorted(groups):
        members = tuple(path for _, path in sorted(groups[name]))
        for path in members:
            digest.update(f"{path.name}\n".encode())
            digest.update(_bytes_of(path))
        given = GivenMasks(members)
        given.weights(2, 2, lights)
        sets.append(given)
    keys = [re.fullmatch(r"(\d{6,})_", name) for name in sorted(groups)]
    places = {int(key[1]): place for place, key in enumerate(keys) if key}
    return GivenMaskPlan(folder.name, tuple(sets), digest.hexdigest(), places if len(places) == len(sets) else {})


def _bytes_of(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise FormatError(f"cannot read {path}: {error.strerror}") from error


def _read(path: Path) -> list[_Array]:
    """Return the masks of a file, (H, W) float32, 0 … 1: one if it is grey or its channels are equal, else three."""
    image = decode_values(_bytes_of(path), path)
    if image.dtype.kind == "u" and image.dtype.itemsize <= 2:
        scaled = np.asarray(image / np.float32(np.iinfo(image.dtype).max), dtype=np.float32)
    elif image.dtype.kind == "f" and np.isfinite(image).all():
        scaled = np.clip(image, 0, 1).astype(np.float32)
    else:
        raise FormatError(f"{path} holds {image.dtype} values, or some that are no numbers; give masks of 8 or 16 bits")
    if scaled.ndim == 2:
        return [scaled]
    grey = bool((scaled == scaled[..., :1]).all())
    return [np.ascontiguousarray(scaled[..., channel]) for channel in range(1 if grey else 3)]


def _fitted(mask: _Array, height: int, width: int) -> _Array:
    """Return a mask (H, W) float32 at the size of the image: averaged over areas to shrink it, else interpolated."""
    import cv2

    if mask.shape == (height, width):
        return mask
    smaller = height <= mask.shape[0] and width <= mask.shape[1]
    interpolation = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(mask, (width, height), interpolation=interpolation), dtype=np.float32)


# Pixels computed at a time: intermediate arrays of so many float32 stay in the processor's cache.
_PIXELS: Final = 1 << 15


@dataclass(frozen=True)
class MadeMasks:
    """The masks of one image, computed."""

    shape: Shape
    streams: RandomStreams

    def weights(self, height: int, width: int, lights: int) -> Weights:
        """Return (height, width, lights) float32 from 0 to 1 in whole 65535ths that sum to 1 in every pixel."""
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
    """Masks of one shape, anew for each image."""

    shape: Shape
    seed: int

    def maker(self, number: int) -> MadeMasks:
        """Return the masks of image `number`."""
        return MadeMasks(self.shape, RandomStreams(self.seed, number))

    def describe(self) -> dict[str, Any]:
        """Return the plan as plain values."""
        return self.shape.describe()


MaskMaker = GivenMasks | MadeMasks  # Where in one picture each of its lights falls

MaskPlan = GivenMaskPlan | MadeMaskPlan  # Masks for every image of a dataset

_SHARE: Range = (0.0, 1.0)  # Least and most of a share
_OPTIONS: Final[dict[str, dict[str, Range]]] = {
    "half-plane": {"angle": (-360.0, 360.0), "width": _SHARE},
    "soft-edge": {"angle": (-360.0, 360.0), "width": _SHARE},
    "spots": {"count": (1.0, 20.0), "radius": (0.01, 1.0), "softness": (0.0, 2.0)},
    "smooth": {"scale": (0.02, 2.0), "contrast": (0.0, 100.0)},
    "window": {"columns": (1.0, 20.0), "rows": (1.0, 20.0), "softness": _SHARE},
}


def parse_masks(text: str, lights: int, seed: int) -> MaskPlan:
    """Return the masks that a text names.

    ``half-plane``, ``soft-edge``, ``spots``, ``smooth`` or ``window``, with numbers where wanted, as in
    ``soft-edge:angle=30,width=.2``, ``spots:count=3,radius=.1,softness=.5``, ``smooth:scale=.3,contrast=8`` and
    ``window:columns=2,rows=3,softness=.05``; anything else is a folder of masks as `find_masks` reads it.
    """
    if text.strip().partition(":")[0] not in _OPTIONS:
        if not text.strip() or not Path(text).is_dir():
            raise InputError(f"{text!r} is neither a folder of masks nor a kind of them: {', '.join(_OPTIONS)}")
        return find_masks(Path(text).absolute(), lights)
    return MadeMaskPlan(parse_shape(text), seed)


def parse_shape(text: str) -> Shape:
    """Return the shape of made masks that a text names, as of `parse_masks`."""
    kind, _, rest = text.strip().partition(":")
    if kind not in _OPTIONS:
        raise InputError(f"{kind!r} is no kind of masks; name one of {', '.join(_OPTIONS)}")
    numbers = parse_numbers(rest, _OPTIONS[kind], f"the masks {kind}")
    whole = {name: _whole(numbers[name], name, kind) for name in ("count", "columns", "rows") if name in numbers}
    match kind:
        case "half-plane" | "soft-edge":
            width = numbers.get("width", 0.0 if kind == "half-plane" else None)
            return HalfPlanes(numbers.get("angle"), width)
        case "spots":
            return Spots(whole.get("count"), numbers.get("radius"), numbers.get("softness", Spots.softness))
        case "smooth":
            return SmoothFields(
                numbers.get("scale", SmoothFields.scale), numbers.get("contrast", SmoothFields.contrast)
            )
        case _:
            return Windows(whole.get("columns"), whole.get("rows"), numbers.get("softness"))


def _whole(number: float, name: str, kind: str) -> int:
    if number != int(number):
        raise InputError(f"{name}={number:g} of the masks {kind}: expected a whole number")
    return int(number)
