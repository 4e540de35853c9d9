"""An image of camera RGB in a file, read when it is used: black subtracted, red first, its mask beside it.

Data sets keep such images as PNG, TIFF or NumPy files of 16 bits or more a channel. Decoders that refuse what is
truncated read them; pictures for the eye (JPEG, 8-bit sRGB) are refused, since their values are not linear.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from evaluation.datasets.truths import Light, read_light
from evaluation.scene import Image
from foundation.errors import FormatError
from generator.files import decode_array

Mask = npt.NDArray[np.bool_]
"""(H, W), True where a pixel must not be used."""


@dataclass(frozen=True, slots=True)
class RawScene:
    """An image in a file, with its levels; a layout with a mask has a subclass.

    - `name`: the image's name, unique in its data set.
    - `light`: linear camera RGB of the light, of any length.
    - `black`: black level, in the units of the file.
    - `white`: value from which a pixel is clipped, in the units of the file, black not subtracted; None if none is.
    """

    name: str
    path: str
    light: Light
    black: float
    white: float | None

    @property
    def truth(self) -> npt.NDArray[np.float64]:
        """The light (3,) float64, linear camera RGB of any length."""
        return np.array(self.light)

    @property
    def saturation(self) -> float | None:
        """Value from which a pixel is clipped, in the units that `read` gives: black is subtracted from it too."""
        return None if self.white is None else self.white - self.black

    def read(self) -> tuple[Image, Mask | None]:
        """Return the image (H, W, 3), linear camera RGB with black at 0, and its mask (H, W) bool or None."""
        image = subtract_black(decode_image(self.path), self.black)
        return image, self.mask(image)

    def mask(self, image: Image) -> Mask | None:
        """Return (H, W) bool, True where a pixel of the image (H, W, 3) must not be used, or None if none is masked."""
        del image
        return None


@dataclass(frozen=True, slots=True)
class BesideTextScene(RawScene):
    """An image whose light stands in a text file of its own, read when it is asked for; `light` is not used.

    Pixels that are zero in every channel are masked: in such data sets that is how charts and faces are painted over.
    """

    truth_path: str = ""

    @property
    def truth(self) -> npt.NDArray[np.float64]:
        """The light (3,) float64, linear camera RGB of any length."""
        return np.array(read_light(self.truth_path))

    def mask(self, image: Image) -> Mask:
        """Return (H, W) bool, True where every channel of the image (H, W, 3) is zero."""
        return zero_pixels(image)


def zero_pixels(image: Image) -> Mask:
    """Return (H, W) bool, True where every channel of an image (H, W, 3) of any dtype is zero.

    Examples
    --------
    >>> zero_pixels(np.array([[[0, 0, 0], [0, 1, 0]]], np.uint16))
    array([[ True, False]])
    """
    return np.asarray((image[..., 0] == 0) & (image[..., 1] == 0) & (image[..., 2] == 0))


def box_mask(shape: tuple[int, int], rows: slice, columns: slice) -> Mask:
    """Return a mask (H, W) bool of that shape, True in a box.

    Examples
    --------
    >>> box_mask((2, 3), slice(1, None), slice(0, 2)).astype(int)
    array([[0, 0, 0],
           [1, 1, 0]])
    """
    mask = np.zeros(shape, dtype=bool)
    mask[rows, columns] = True
    return mask


def polygon_mask(shape: tuple[int, int], corners: npt.NDArray[np.float64]) -> Mask:
    """Return a mask (H, W) bool of that shape, True in and on a polygon.

    `corners`: (N, 2) float64, x then y, px, pixel centres at integers; rounded to whole pixels.

    Examples
    --------
    >>> polygon_mask((3, 4), np.array([[1.0, 0.0], [2.0, 0.0], [2.0, 1.2], [1.0, 1.2]])).astype(int)
    array([[0, 1, 1, 0],
           [0, 1, 1, 0],
           [0, 0, 0, 0]])
    """
    import cv2

    mask = np.zeros(shape, dtype=np.uint8)
    cv2.fillPoly(mask, [np.rint(corners).astype(np.int32)], (1,))
    return np.asarray(mask, dtype=bool)


def subtract_black(image: Image, black: float) -> Image:
    """Return an image (H, W, 3) with a black level subtracted, 0 where it was below; the image given is used up.

    It stays uint16 where the level is whole, and becomes float32 where it is not; float images keep their dtype.

    Examples
    --------
    >>> subtract_black(np.array([[[2047, 2048, 2050]]], np.uint16), 2048)
    array([[[0, 0, 2]]], dtype=uint16)
    """
    import cv2

    if image.dtype == np.uint16 and not float(black).is_integer():
        image = image.astype(np.float32)
    if black:
        if not image.flags.c_contiguous:
            # A TIFF may hold a plane a channel, which OpenCV does not write to.
            image = image.copy(order="C")
        cv2.subtract(image, np.array([black, black, black, 0.0]), dst=image)  # Saturates at 0 in integers.
    return image if image.dtype == np.uint16 else np.maximum(image, 0, out=image)


def decode_image(path: str, eight_bits: bool = False) -> Image:
    """Return the image (H, W, 3) of a file as its numbers are, red first: uint16, float32 or float64.

    `eight_bits`: whether 8 bits a channel are taken, as uint16 of the same values.
    """
    image = _values(path)
    if image.ndim != 3 or image.shape[2] != 3 or not image.size:
        raise FormatError(f"{path} holds an image {image.shape}, expected (height, width, 3): linear camera RGB")
    if image.dtype == np.uint8:
        if not eight_bits:
            raise FormatError(
                f"{path} has 8 bits a channel, as pictures for the eye (sRGB) have, expected linear camera RGB of 16 "
                "bits; make a linear TIFF of the raw file with dcraw -h -D -4 -T, which neither balances white nor "
                "subtracts black: its black level is for you to give"
            )
        return image.astype(np.uint16)
    if image.dtype.name not in ("uint16", "float32", "float64"):
        raise FormatError(f"{path} holds {image.dtype}, expected uint16, float32 or float64")
    if image.dtype != np.uint16 and not np.isfinite(image).all():
        raise FormatError(f"{path} has values that are not finite, expected linear camera RGB; make it again")
    return image


def _values(path: str) -> npt.NDArray[Any]:
    """Return whatever array a file holds."""
    ending = Path(path).suffix.lower()
    try:
        if ending == ".npy":
            return np.asarray(np.load(path, allow_pickle=False))
        data = Path(path).read_bytes()
        if ending == ".png":
            return decode_array(data, "png")
        if ending in (".tif", ".tiff"):
            return decode_array(data, "tiff")
    except Exception as error:
        reason = (isinstance(error, OSError) and error.strerror) or " ".join(str(error).split())
        raise FormatError(f"{path} cannot be read: {reason or type(error).__name__}; restore it") from error
    raise FormatError(f"{path} ends in {ending!r}, expected .png, .tif, .tiff or .npy: linear camera RGB of 16 bits")
