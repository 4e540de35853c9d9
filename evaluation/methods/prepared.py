"""An image with what methods share, found once: usable pixels, moments, Gaussian derivatives.

    prepared = PreparedImage(image, saturation, mask)
    lights = [estimate(method, prepared) for method in methods]

A method that can use it has `estimate_prepared(prepared)`; `estimate` calls it where there is one. Images are read in
their own dtype, row by row or in tiles, so beside the image a method needs:

- one byte a pixel for the usable ones, where something is masked or saturated;
- for a derivative one tile and what its filters need, 2 MB, whatever the size;
- for images of at most `KEPT_PIXELS`, each derivative that was asked for twice, which is then kept: 12 bytes a pixel.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, Protocol, cast, runtime_checkable

import numpy as np
import numpy.typing as npt

from evaluation.methods.method import Method
from evaluation.scene import Image

# The estimate (3,) float64 where no pixel is usable, or every one is black: no colour cast. Methods then return this
# very array, which distinguishes it from an estimate that happens to be grey.
GREY = np.full(3, 3**-0.5)
GREY.setflags(write=False)


def dilate_clipped(
    image: npt.NDArray[np.integer[Any]] | npt.NDArray[np.floating[Any]], saturation: float
) -> npt.NDArray[np.bool_]:
    """Return (H, W) bool, True where a channel is saturated or a neighbour's is.

    The image is (H, W, 3) of any dtype.
    """
    import cv2

    from evaluation.methods.pixel_loops import mark_clipped

    clipped = np.zeros(image.shape[:2], dtype=np.uint8)
    kind: Any = image.dtype
    if kind.kind in "iu":
        if saturation > np.iinfo(kind).max:
            return clipped.view(np.bool_)
        limit = kind.type(max(0, math.ceil(saturation)))
    else:
        limit = kind.type(saturation)
    native: Any = np.ascontiguousarray(image, dtype=kind.newbyteorder("="))
    if mark_clipped(native, limit, clipped):
        clipped = cv2.dilate(clipped, np.ones((3, 3), np.uint8))
    return np.asarray(clipped).view(np.bool_)


def unit(estimate: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return `estimate` (3,) as float64 scaled to length 1, or `GREY` where it is zero or not finite.

    Examples
    --------
    >>> unit([3, 4, 0])
    array([0.6, 0.8, 0. ])
    >>> unit([0, 0, 0]) is GREY
    True
    """
    vector = np.asarray(estimate, dtype=np.float64)
    length = float(np.linalg.norm(vector))
    return vector / length if np.isfinite(length) and length > 0 else GREY


def shrink(
    image: Image, usable: npt.NDArray[np.bool_], longest: int, least: float = 0.5
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_]]:
    """Return an image whose longer side is `longest` px, and where it must not be used.

    A pixel is the mean, weighted by area, of the usable pixels that it stands for.

    `image`: (H, W, 3) uint16, float32 or float64. `usable`: (H, W) bool, True where a pixel may be used. `longest`: px,
    below the longer side. `least`: share of a pixel's area, 0 … 1, that must be exceeded by what is usable of it.
    Returns (h, w, 3) float32, 0 where nothing is usable; (h, w) bool, True where no more of a pixel is usable than
    `least`.
    """
    import cv2

    height, width = usable.shape
    factor = longest / max(height, width)
    size = (max(1, round(width * factor)), max(1, round(height * factor)))
    share = np.asarray(cv2.resize(usable.astype(np.float32), size, interpolation=cv2.INTER_AREA))
    planes: list[npt.NDArray[np.float32]] = []
    for channel in range(3):
        kept = np.where(usable, image[..., channel], 0).astype(np.float32)
        planes.append(np.asarray(cv2.resize(kept, size, interpolation=cv2.INTER_AREA), dtype=np.float32))
    found = np.stack(planes, axis=-1) / np.maximum(share, np.finfo(np.float32).tiny)[..., None]
    masked = share <= least
    found[share <= 0] = 0
    return found.astype(np.float32), masked


KEPT_PIXELS = 1 << 20  # Pixels up to which derivatives are kept for the next method: 12 MB each

# Norm up to which no power of a value between 1 and 1e-19 of the image's largest leaves the range of float64. So the
# largest usable value need not be found first.
SAFE_POWER = 16

_ALL = np.zeros((0, 0), dtype=bool)  # Stands for: every pixel may be used


@runtime_checkable
class PreparedMethod(Protocol):
    """A method that can use what other methods have found of an image; a `Method` that inherits it has `estimate`."""

    def estimate_prepared(self, prepared: PreparedImage) -> npt.NDArray[np.float64]:
        """Return what `Method.estimate` returns of the same image: (3,) float64 of length 1, or `GREY`."""
        ...

    def estimate(
        self, image: Image, saturation: float | None = None, mask: npt.NDArray[np.bool_] | None = None
    ) -> npt.NDArray[np.float64]:
        """Return the light (3,) float64, camera RGB of length 1; see `method.Method.estimate`."""
        return self.estimate_prepared(PreparedImage(image, saturation, mask))


class PreparedImage:
    """An image whose shared parts are found when they are first asked for, and kept; for one thread at a time.

    `image`: (H, W, 3) uint16, float32 or float64, linear camera RGB ≥ 0; not to be changed as long as this is used.
    Other dtypes are converted, uint8 to uint16 and all else to float64. `saturation`: value from which a channel is
    clipped; None if none is. `mask`: (H, W) bool, True where a pixel must not be used; None if every one may be.

    Examples
    --------
    >>> prepared = PreparedImage(np.full((4, 5, 3), [2, 4, 6], np.uint16))
    >>> prepared.moments(border=0)[0]
    array([ 40.,  80., 120.])
    """

    def __init__(
        self, image: Image, saturation: float | None = None, mask: npt.NDArray[np.bool_] | None = None
    ) -> None:
        self.image: Image = _readable(image)
        self.saturation = saturation
        self.mask = mask
        self._free: npt.NDArray[np.bool_] | None = None
        self._peak: float | None = None
        self._moments: dict[int, npt.NDArray[np.float64]] = {}
        self._norms: dict[tuple[int, float, float, int], npt.NDArray[np.float64]] = {}
        self._derivatives: dict[tuple[int, float], npt.NDArray[np.float32]] = {}
        self._asked: set[tuple[int, float]] = set()
        self._smaller: dict[int, PreparedImage] = {}

    @property
    def height(self) -> int:
        """Rows of the image."""
        return self.image.shape[0]

    @property
    def width(self) -> int:
        """Columns of the image."""
        return self.image.shape[1]

    @property
    def peak(self) -> float:
        """Largest value of the image, of any pixel."""
        if self._peak is None:
            self._peak = float(self.image.max(initial=0))
        return self._peak

    @property
    def scale(self) -> float:
        """Power of two that brings the largest value of a float image to 0.5 … 1; 1 for black and for whole numbers.

        So float32 holds what is left, and its square.
        """
        if self.image.dtype == np.uint16 or not 0 < self.peak < math.inf:
            return 1.0
        return math.ldexp(1.0, -math.frexp(self.peak)[1])

    @property
    def white(self) -> float:
        """The value that counts as white where a method needs one: the saturation, else the largest value."""
        return float(self.saturation) if self.saturation is not None else self.peak

    def free(self) -> npt.NDArray[np.bool_]:
        """Return (H, W) bool, True where a pixel may be used; (0, 0) where every one may be.

        Left out are masked pixels and those of which a channel is saturated, with their eight neighbours.
        """
        if self._free is None:
            clipped = None
            if self.saturation is not None and self.peak >= self.saturation:
                clipped = dilate_clipped(self.image, self.saturation)
            if clipped is None:
                self._free = _ALL if self.mask is None or not self.mask.any() else ~self.mask
            else:
                self._free = ~clipped if self.mask is None else ~(clipped | self.mask)
        return self._free

    def usable(self, border: int = 0) -> npt.NDArray[np.bool_]:
        """Return (H, W) bool, True where a pixel may be used and lies `border` px within every edge.

        Examples
        --------
        >>> image = np.zeros((5, 6, 3))
        >>> image[0, 0] = 900
        >>> PreparedImage(image, saturation=800).usable().astype(int)
        array([[0, 0, 1, 1, 1, 1],
               [0, 0, 1, 1, 1, 1],
               [1, 1, 1, 1, 1, 1],
               [1, 1, 1, 1, 1, 1],
               [1, 1, 1, 1, 1, 1]])
        """
        free = self.free()
        if not border:
            return free if free.size else np.ones((self.height, self.width), dtype=bool)
        inside = np.zeros((self.height, self.width), dtype=bool)
        core = np.s_[border : max(border, self.height - border), border : max(border, self.width - border)]
        inside[core] = free[core] if free.size else True
        return inside

    def moments(self, border: int = 0) -> npt.NDArray[np.float64]:
        """Return (4, 3) float64 of the usable pixels: sum, sum of squares, maximum of each channel; their count thrice.

        Whole numbers are summed exactly, floats in float64.
        """
        if border not in self._moments:
            from evaluation.methods.pixel_loops import float_moments, whole_moments

            if self.image.dtype == np.uint16:
                whole, count = whole_moments(cast("Any", self.image), self.free(), border)
                found = whole.astype(np.float64)
            else:
                found, count = float_moments(cast("Any", self.image), self.free(), border, self.scale)
                found = found / np.array([[self.scale], [self.scale**2], [self.scale]])
            self._moments[border] = np.concatenate([found, np.full((1, 3), float(count))])
        return self._moments[border]

    def norm(self, order: int, sigma: float, p: float, border: int) -> npt.NDArray[np.float64]:
        """Return (3,) float64, in an arbitrary unit: the Minkowski p-norm of each channel's Gaussian derivative.

        `sigma`: scale of the Gaussian, px; 0 for none.
        """
        if not sigma and p in (1, 2, math.inf):
            sums, squares, peaks, _ = self.moments(border)
            return np.sqrt(squares) if p == 2 else sums if p == 1 else peaks
        key = (order, sigma, p, border)
        if key not in self._norms:
            scale = 1.0
            if not math.isinf(p) and p != 1:
                if p <= SAFE_POWER and self.peak:
                    scale = 1 / (self.peak * self.scale) if sigma else 1 / self.peak
                else:
                    largest = self.norm(order, sigma, math.inf, border).max()
                    if not largest:
                        return np.zeros(3)
                    scale = 1 / float(largest)
            sums = self._sum_powers(order, sigma, p, border, scale)
            self._norms[key] = sums if math.isinf(p) or p == 1 else sums ** (1 / p)
        return self._norms[key]

    def _sum_powers(self, order: int, sigma: float, p: float, border: int, scale: float) -> npt.NDArray[np.float64]:
        from evaluation.methods.pixel_loops import sum_powers

        sums = np.zeros(3)
        shape = (self.height, self.width)
        if not sigma:
            flat = self.image.reshape(self.height, -1)
            sum_powers(cast("Any", flat), self.free(), border, 0, 0, *shape, p, scale, sums)
            return sums
        for top, left, tile in self.tiles(order, sigma):
            sum_powers(tile, self.free(), border, top, left, *shape, p, scale, sums)
        return sums

    def derivative(self, order: int, sigma: float) -> npt.NDArray[np.float32]:
        """Return the size of the image's Gaussian derivative, (H, W, 3) float32, in units of 1 / `scale`.

        Order 0 is the smoothed image, 1 the gradient's length, 2 √(f_xx² + 4 f_xy² + f_yy²); edges are continued by
        their last pixel. Kept for images of at most `KEPT_PIXELS`.
        """
        key = (order, float(sigma))
        if key in self._derivatives:
            return self._derivatives[key]
        from evaluation.methods.gaussian import differentiated_tiles, put_tile

        found = np.empty((self.height, self.width, 3), dtype=np.float32)
        for top, left, tile in differentiated_tiles(self.image, order, sigma, self.scale):
            put_tile(found, top, left, tile)
        if self.height * self.width <= KEPT_PIXELS:
            self._derivatives[key] = found
        return found

    def at_most(self, longest: int) -> PreparedImage:
        """Return the image, prepared, with its longer side shrunk to so many px; itself where it is no longer.

        The smaller image is float32 and holds means of usable pixels; see `shrinking.shrink`.
        """
        if max(self.height, self.width) <= longest:
            return self
        if longest not in self._smaller:
            image, mask = shrink(self.image, self.usable(0), longest)
            self._smaller[longest] = PreparedImage(image, None, mask)
        return self._smaller[longest]

    def tiles(self, order: int, sigma: float) -> Iterator[tuple[int, int, npt.NDArray[np.float32]]]:
        """Yield the derivative in tiles: first row and pixel, (rows, Q) float32, good until the next.

        A row may go on beyond the image. Most derivatives are wanted once: only what is asked for again is kept.
        """
        from evaluation.methods.gaussian import differentiated_tiles

        key = (order, float(sigma))
        if key in self._asked and self.height * self.width <= KEPT_PIXELS:
            yield 0, 0, self.derivative(order, sigma).reshape(self.height, -1)
        else:
            self._asked.add(key)
            yield from differentiated_tiles(self.image, order, sigma, self.scale)


def usable(
    image: Image, saturation: float | None, mask: npt.NDArray[np.bool_] | None, border: int = 0
) -> npt.NDArray[np.bool_]:
    """Return (H, W) bool, True where a pixel may be used, for a method that prepares nothing.

    See `PreparedImage.usable`. `image`: (H, W, 3), linear camera RGB. `saturation`, `mask`: as of `Method.estimate`.
    `border`: px along every edge.
    """
    return PreparedImage(image, saturation, mask).usable(border)


def estimate(method: Method, prepared: PreparedImage) -> npt.NDArray[np.float64]:
    """Return a method's estimate of a prepared image: (3,) float64 of length 1, or `GREY`.

    Examples
    --------
    >>> from evaluation.methods.standard import standard_methods
    >>> prepared = PreparedImage(np.full((4, 5, 3), [2, 4, 4], np.uint16))
    >>> [estimate(standard_methods()[name], prepared).round(3).tolist() for name in ("gray-world", "white-patch")]
    [[0.333, 0.667, 0.667], [0.333, 0.667, 0.667]]
    """
    if isinstance(method, PreparedMethod):
        return method.estimate_prepared(prepared)
    return method.estimate(prepared.image, prepared.saturation, prepared.mask)


def estimate_all(
    methods: Sequence[Method],
    image: Image,
    saturation: float | None = None,
    mask: npt.NDArray[np.bool_] | None = None,
) -> list[npt.NDArray[np.float64]]:
    """Return each method's estimate of one image, (3,) float64; the image is prepared once.

    `image`: (H, W, 3) uint16, float32 or float64. `saturation`, `mask`: see `Method.estimate`; the mask is (H, W) bool.
    """
    prepared = PreparedImage(image, saturation, mask)
    return [estimate(method, prepared) for method in methods]


def _readable(image: npt.NDArray[Any]) -> Any:
    """Return the image contiguous, in one of the three dtypes and this machine's byte order; itself where it is."""
    if image.dtype.type in (np.uint16, np.float32, np.float64):
        kind = image.dtype.newbyteorder("=")
    else:
        kind = np.dtype(np.uint16 if image.dtype == np.uint8 else np.float64)
    return np.ascontiguousarray(image, dtype=kind)
