"""Prepare an image for several methods: usable pixels, moments and Gaussian derivatives are computed once.

    prepared = PreparedImage(image, saturation, mask)
    lights = [estimate(method, prepared) for method in methods]

If a method has `estimate_prepared(prepared)`, the function `estimate` calls it instead of `method.estimate`. Images are
processed in their own dtype, row by row or in tiles. The additional memory is:

- one byte per pixel if pixels are masked or saturated;
- 2 MB for a derivative, for images of any size;
- 12 bytes per pixel for each derivative that is requested twice, for images of at most `CACHED_PIXELS`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, Protocol, cast, runtime_checkable

import numpy as np
import numpy.typing as npt

from evaluation.methods.method import Method
from evaluation.scene import Image

# Estimate (3,) float64 if no pixel is usable or all pixels are black. Methods return this object itself. Callers use
# `is` to distinguish it from the estimate of a grey image.
GREY = np.full(3, 3**-0.5)
GREY.setflags(write=False)


def dilate_clipped(
    image: npt.NDArray[np.integer[Any]] | npt.NDArray[np.floating[Any]], saturation: float
) -> npt.NDArray[np.bool_]:
    """Return (H, W) bool, True for pixels with a saturated channel and for their eight neighbours."""
    import cv2

    from evaluation.methods.pixel_loops import mark_clipped

    clipped = np.zeros(image.shape[:2], dtype=np.uint8)
    dtype: Any = image.dtype
    if dtype.kind in "iu":
        if saturation > np.iinfo(dtype).max:
            return clipped.view(np.bool_)
        limit = dtype.type(max(0, math.ceil(saturation)))
    else:
        limit = dtype.type(saturation)
    native_image: Any = np.ascontiguousarray(image, dtype=dtype.newbyteorder("="))
    if mark_clipped(native_image, limit, clipped):
        clipped = cv2.dilate(clipped, np.ones((3, 3), np.uint8))
    return np.asarray(clipped).view(np.bool_)


def unit(estimate: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return `estimate` (3,) as float64 scaled to length 1, or `GREY` if it is zero or not finite.

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
    image: Image, usable: npt.NDArray[np.bool_], longest: int, min_share: float = 0.5
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_]]:
    """Return an image whose longer side is `longest` px, (h, w, 3) float32, and its mask (h, w) bool.

    Each new pixel is the mean of the usable pixels in its area. It is masked (True) if usable pixels cover `min_share`
    of the area or less (0 … 1).
    """
    import cv2

    height, width = usable.shape
    factor = longest / max(height, width)
    size = (max(1, round(width * factor)), max(1, round(height * factor)))
    share = np.asarray(cv2.resize(usable.astype(np.float32), size, interpolation=cv2.INTER_AREA))
    planes: list[npt.NDArray[np.float32]] = []
    for channel in range(3):
        values = np.where(usable, image[..., channel], 0).astype(np.float32)
        planes.append(np.asarray(cv2.resize(values, size, interpolation=cv2.INTER_AREA), dtype=np.float32))
    means = np.stack(planes, axis=-1) / np.maximum(share, np.finfo(np.float32).tiny)[..., None]
    masked = share <= min_share
    means[share <= 0] = 0
    return means.astype(np.float32), masked


CACHED_PIXELS = 1 << 20  # largest image whose derivatives are kept, px; each takes up to 12 MB

# Up to this p, values are divided by the largest value of the image, because powers of ratios above 1e-19 do not
# underflow. For larger p, values are divided by the largest usable value, which needs a second pass.
SAFE_POWER = 16

_ALL_USABLE = np.zeros((0, 0), dtype=bool)  # stands for a mask with all pixels usable


@runtime_checkable
class PreparedMethod(Protocol):
    """A method that accepts a prepared image. Classes that inherit from it get `Method.estimate`."""

    def estimate_prepared(self, prepared: PreparedImage) -> npt.NDArray[np.float64]:
        """Return the estimate of a prepared image, (3,) float64, camera RGB of length 1, or `GREY`."""
        ...

    def estimate(
        self, image: Image, saturation: float | None = None, mask: npt.NDArray[np.bool_] | None = None
    ) -> npt.NDArray[np.float64]:
        """Return the estimate (3,) float64, camera RGB of length 1; see `method.Method.estimate`."""
        return self.estimate_prepared(PreparedImage(image, saturation, mask))


class PreparedImage:
    """Image with intermediate results for several methods, computed on first use; not thread-safe.

    Parameters
    ----------
    image
        (H, W, 3) uint16, float32 or float64, linear camera RGB ≥ 0; must not be changed during use. uint8 is converted
        to uint16, all other types to float64.
    saturation
        A channel of at least this value is clipped, in the unit of the image; None if no pixel is clipped.
    mask
        (H, W) bool, True for pixels that must not be used; None if all may be used.

    Examples
    --------
    >>> prepared = PreparedImage(np.full((4, 5, 3), [2, 4, 6], np.uint16))
    >>> prepared.moments(border=0)[0]
    array([ 40.,  80., 120.])
    """

    def __init__(
        self, image: Image, saturation: float | None = None, mask: npt.NDArray[np.bool_] | None = None
    ) -> None:
        self.image: Image = _native_image(image)
        self.saturation = saturation
        self.mask = mask
        self._usable_pixels: npt.NDArray[np.bool_] | None = None
        self._peak: float | None = None
        self._moments: dict[int, npt.NDArray[np.float64]] = {}
        self._norms: dict[tuple[int, float, float, int], npt.NDArray[np.float64]] = {}
        self._derivatives: dict[tuple[int, float], npt.NDArray[np.float32]] = {}
        self._requested: set[tuple[int, float]] = set()
        self._shrunk: dict[int, PreparedImage] = {}

    @property
    def height(self) -> int:
        """Number of rows."""
        return self.image.shape[0]

    @property
    def width(self) -> int:
        """Number of columns."""
        return self.image.shape[1]

    @property
    def peak(self) -> float:
        """Largest value of the image, usable or not."""
        if self._peak is None:
            self._peak = float(self.image.max(initial=0))
        return self._peak

    @property
    def scale(self) -> float:
        """Power of two that scales the largest value of a float image to 0.5 … 1; 1 for black images and for uint16."""
        # After scaling, values and their squares are in the range of float32.
        if self.image.dtype == np.uint16 or not 0 < self.peak < math.inf:
            return 1.0
        return math.ldexp(1.0, -math.frexp(self.peak)[1])

    @property
    def white(self) -> float:
        """Value used as white: the saturation, or the largest value if the saturation is unknown."""
        return float(self.saturation) if self.saturation is not None else self.peak

    def usable_or_empty(self) -> npt.NDArray[np.bool_]:
        """Return (H, W) bool, True for usable pixels; (0, 0) if all pixels are usable.

        Masked pixels, and pixels with a saturated channel and their eight neighbours, are not usable.
        """
        if self._usable_pixels is None:
            clipped = None
            if self.saturation is not None and self.peak >= self.saturation:
                clipped = dilate_clipped(self.image, self.saturation)
            if clipped is None:
                self._usable_pixels = _ALL_USABLE if self.mask is None or not self.mask.any() else ~self.mask
            else:
                self._usable_pixels = ~clipped if self.mask is None else ~(clipped | self.mask)
        return self._usable_pixels

    def usable(self, border: int = 0) -> npt.NDArray[np.bool_]:
        """Return (H, W) bool, True for usable pixels with a distance of `border` px or more from all edges.

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
        pixels = self.usable_or_empty()
        if not border:
            return pixels if pixels.size else np.ones((self.height, self.width), dtype=bool)
        inside = np.zeros((self.height, self.width), dtype=bool)
        core = np.s_[border : max(border, self.height - border), border : max(border, self.width - border)]
        inside[core] = pixels[core] if pixels.size else True
        return inside

    def moments(self, border: int = 0) -> npt.NDArray[np.float64]:
        """Return sum, sum of squares, maximum and count of the usable pixels per channel, (4, 3) float64.

        Sums of uint16 are exact; floats are summed in float64.
        """
        if border not in self._moments:
            from evaluation.methods.pixel_loops import float_moments, integer_moments

            if self.image.dtype == np.uint16:
                exact_sums, count = integer_moments(cast("Any", self.image), self.usable_or_empty(), border)
                sums = exact_sums.astype(np.float64)
            else:
                sums, count = float_moments(cast("Any", self.image), self.usable_or_empty(), border, self.scale)
                sums = sums / np.array([[self.scale], [self.scale**2], [self.scale]])
            self._moments[border] = np.concatenate([sums, np.full((1, 3), float(count))])
        return self._moments[border]

    def norm(self, order: int, sigma: float, p: float, border: int) -> npt.NDArray[np.float64]:
        """Return the Minkowski p-norm of the Gaussian derivative of each channel, (3,) float64, in an arbitrary unit.

        `sigma` is the scale of the Gaussian in px; 0 for no filter.
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
            sum_powers(cast("Any", flat), self.usable_or_empty(), border, 0, 0, *shape, p, scale, sums)
            return sums
        for top, left, tile in self.tiles(order, sigma):
            sum_powers(tile, self.usable_or_empty(), border, top, left, *shape, p, scale, sums)
        return sums

    def derivative(self, order: int, sigma: float) -> npt.NDArray[np.float32]:
        """Return the magnitude of the Gaussian derivative, (H, W, 3) float32, multiplied by `scale`.

        Order 0 is the smoothed image, order 1 the length of the gradient, order 2 √(f_xx² + 4 f_xy² + f_yy²). Positions
        outside the image have the value of the nearest pixel.
        """
        key = (order, float(sigma))
        if key in self._derivatives:
            return self._derivatives[key]
        from evaluation.methods.gaussian import differentiated_tiles, put_tile

        values = np.empty((self.height, self.width, 3), dtype=np.float32)
        for top, left, tile in differentiated_tiles(self.image, order, sigma, self.scale):
            put_tile(values, top, left, tile)
        if self.height * self.width <= CACHED_PIXELS:
            self._derivatives[key] = values
        return values

    def shrunk(self, longest: int) -> PreparedImage:
        """Return the image reduced to a longer side of `longest` px by `shrink`, or itself if it is not larger."""
        if max(self.height, self.width) <= longest:
            return self
        if longest not in self._shrunk:
            image, mask = shrink(self.image, self.usable(0), longest)
            self._shrunk[longest] = PreparedImage(image, None, mask)
        return self._shrunk[longest]

    def tiles(self, order: int, sigma: float) -> Iterator[tuple[int, int, npt.NDArray[np.float32]]]:
        """Yield the derivative in tiles, see `gaussian.differentiated_tiles`."""
        # A derivative is kept from its second request on, because most derivatives are requested only once.
        from evaluation.methods.gaussian import differentiated_tiles

        key = (order, float(sigma))
        if key in self._requested and self.height * self.width <= CACHED_PIXELS:
            yield 0, 0, self.derivative(order, sigma).reshape(self.height, -1)
        else:
            self._requested.add(key)
            yield from differentiated_tiles(self.image, order, sigma, self.scale)


def usable(
    image: Image, saturation: float | None, mask: npt.NDArray[np.bool_] | None, border: int = 0
) -> npt.NDArray[np.bool_]:
    """Return the usable pixels as `PreparedImage.usable` does, for callers that need nothing else of the image."""
    return PreparedImage(image, saturation, mask).usable(border)


def estimate(method: Method, prepared: PreparedImage) -> npt.NDArray[np.float64]:
    """Return the estimate of a method for a prepared image, (3,) float64 of length 1, or `GREY`.

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
    methods: Sequence[Method], image: Image, saturation: float | None = None, mask: npt.NDArray[np.bool_] | None = None
) -> list[npt.NDArray[np.float64]]:
    """Return the estimates (3,) float64 of several methods for one image, which is prepared once."""
    prepared = PreparedImage(image, saturation, mask)
    return [estimate(method, prepared) for method in methods]


def _native_image(image: npt.NDArray[Any]) -> Any:
    # Compiled loops require contiguous arrays of three dtypes in native byte order.
    if image.dtype.type in (np.uint16, np.float32, np.float64):
        dtype = image.dtype.newbyteorder("=")
    else:
        dtype = np.dtype(np.uint16 if image.dtype == np.uint8 else np.float64)
    return np.ascontiguousarray(image, dtype=dtype)
