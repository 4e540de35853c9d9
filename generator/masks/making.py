"""Where each of several lights falls in a picture: masks made anew for each image, at any size.

A plan makes the masks of image after image; a maker makes those of one image at any size. The laws that hold inside:

- Lengths are shares of the picture's longer side, and noise has its place in the picture and not in a pixel. So the
  masks of one seed and number look the same at every size; an edge is never sharper than one pixel.
- What is made depends on the seed and the image's number alone; purpose 5 of `philox`.
- Every pixel is computed with +, −, ×, ÷ and √ alone, which IEEE 754 rounds alike everywhere. So the same masks are
  the same bytes on every processor, up to the last bit of the few sines that place the shapes.

The first light is the one that falls where no shape is.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np
import numpy.typing as npt

from foundation.compiled import compiled
from foundation.errors import InputError
from generator.lights.lighting import FULL, MaskMaker
from generator.lights.options import Range, parse_numbers
from generator.masks.shapes import Array, Dice, HalfPlanes, Shape, SmoothFields, Spots, Windows

Weights = npt.NDArray[np.float32]
_PIXELS: Final = 1 << 15
"""Pixels computed at a time: what is between stays in the processor's cache, and in memory that a program has."""
_FULL: Final = np.float32(FULL)
_WHOLE: Final = np.int32(FULL)
_HALF: Final = np.float32(0.5)


class MaskPlan(Protocol):
    """Masks for every image of a dataset."""

    def maker(self, number: int) -> MaskMaker:
        """Return the masks of image `number`."""
        ...

    def describe(self) -> dict[str, Any]:
        """Return the plan as plain values for `dataset.json`."""
        ...


@dataclass(frozen=True)
class MadeMasks:
    """The masks of one image; a `MaskMaker`."""

    shape: Shape
    dice: Dice

    def weights(self, height: int, width: int, lights: int) -> Weights:
        """Return (height, width, lights) float32 from 0 to 1 in whole 65535ths that sum to 1 in every pixel."""
        longer = max(height, width)
        u = ((np.arange(width) - (width - 1) / 2) / longer).astype(np.float32)[None, :]
        v = ((np.arange(height) - (height - 1) / 2) / longer).astype(np.float32)[:, None]
        shares = self.shape.shares(self.dice, (width / longer / 2, height / longer / 2), lights, 1 / longer, u)
        out = np.empty((height, width, lights), np.float32)
        rows = max(1, _PIXELS // width)
        for top in range(0, height, rows):
            whole_parts(shares(v[top : top + rows]), out[top : top + rows])
        return out


@dataclass(frozen=True)
class MadeMaskPlan:
    """Masks of one shape, anew for each image; a `MaskPlan`."""

    shape: Shape
    seed: int

    def maker(self, number: int) -> MaskMaker:
        """Return the masks of image `number`."""
        return MadeMasks(self.shape, Dice(self.seed, number))

    def describe(self) -> dict[str, Any]:
        """Return the plan as plain values."""
        return self.shape.describe()


@compiled
def _fill_whole_parts_of_two(first: Any, second: Any, out: Any) -> None:
    """Do what `_fill_whole_parts` does, for `out` (H, 2 W), in a loop of which the compiler makes vectors."""
    for y in range(first.shape[0]):
        for x in range(first.shape[1]):
            total = first[y, x] + second[y, x]
            one = np.int32(first[y, x] / total * _FULL + _HALF)
            other = np.int32(second[y, x] / total * _FULL + _HALF)
            left, is_less = np.int32(_WHOLE - one - other), np.int32(second[y, x] > first[y, x])
            out[y, 2 * x] = np.float32(np.int32(one + left * np.int32(1 - is_less))) / _FULL
            out[y, 2 * x + 1] = np.float32(np.int32(other + left * is_less)) / _FULL


@compiled
def _fill_whole_parts(shares: Any, out: Any) -> None:
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


def whole_parts(shares: Array, out: Weights) -> None:
    """Fill `out` with shares as whole 65535ths that sum to 1; the largest takes what rounding leaves.

    Parameters
    ----------
    shares
        (K, H, W) float32 ≥ 0, not all 0 in a pixel.
    out
        (H, W, K) float32, 0 to 1, contiguous.
    """
    if len(shares) == 2:
        _fill_whole_parts_of_two(shares[0], shares[1], out.reshape(len(out), -1))
    else:
        _fill_whole_parts(shares, out)


_SHARE: Range = (0.0, 1.0)
_OPTIONS: dict[str, dict[str, Range]] = {
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
    ``window:columns=2,rows=3,softness=.05``; anything else is a folder of masks as `files` reads it.

    Parameters
    ----------
    text
        What was written.
    lights
        Lights of an image, 2 or more.
    seed
        Of the masks that are made.

    Raises
    ------
    InputError
        It names none, or a number is out of range.
    FormatError
        The folder's files are no masks for that many lights.
    """
    kind, _, rest = text.strip().partition(":")
    if kind not in _OPTIONS:
        if not text.strip() or not Path(text).is_dir():
            raise InputError(f"{text!r} is neither a folder of masks nor a kind of them: {', '.join(_OPTIONS)}")
        from generator.masks.files import find_masks

        return find_masks(Path(text).absolute(), lights)
    numbers = parse_numbers(rest, _OPTIONS[kind], f"the masks {kind}")
    whole = {name: _whole(numbers[name], name, kind) for name in ("count", "columns", "rows") if name in numbers}
    match kind:
        case "half-plane" | "soft-edge":
            width = numbers.get("width", 0.0 if kind == "half-plane" else None)
            shape: Shape = HalfPlanes(numbers.get("angle"), width)
        case "spots":
            shape = Spots(whole.get("count"), numbers.get("radius"), numbers.get("softness", Spots.softness))
        case "smooth":
            shape = SmoothFields(
                numbers.get("scale", SmoothFields.scale), numbers.get("contrast", SmoothFields.contrast)
            )
        case _:
            shape = Windows(whole.get("columns"), whole.get("rows"), numbers.get("softness"))
    return MadeMaskPlan(shape, seed)


def _whole(number: float, name: str, kind: str) -> int:
    if number != int(number):
        raise InputError(f"{name}={number:g} of the masks {kind}: expected a whole number")
    return int(number)
