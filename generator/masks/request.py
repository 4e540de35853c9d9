"""Masks as a user writes them on a command line."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from foundation.errors import InputError
from generator.masks.given import find_masks
from generator.masks.making import MadeMaskPlan
from generator.masks.shapes import HalfPlanes, Shape, SmoothFields, Spots, Windows
from generator.masks.weights import MaskPlan
from generator.named_numbers import Range, parse_numbers

_SHARE: Range = (0.0, 1.0)
"""Least and most of a share."""
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
    ``window:columns=2,rows=3,softness=.05``; anything else is a folder of masks as `given.find_masks` reads it.

    Examples
    --------
    >>> weights = parse_masks("half-plane:angle=0", lights=2, seed=1).maker(0).weights(2, 6, 2)
    >>> weights.shape, weights.dtype, weights.sum(axis=2).min()
    ((2, 6, 2), dtype('float32'), np.float32(1.0))
    """
    if text.strip().partition(":")[0] not in _OPTIONS:
        if not text.strip() or not Path(text).is_dir():
            raise InputError(f"{text!r} is neither a folder of masks nor a kind of them: {', '.join(_OPTIONS)}")
        return find_masks(Path(text).absolute(), lights)
    return MadeMaskPlan(parse_shape(text), seed)


def parse_shape(text: str) -> Shape:
    """Return the shape of made masks that a text names, as of `parse_masks`.

    Examples
    --------
    >>> parse_shape("soft-edge:angle=30,width=.2")
    HalfPlanes(angle=30.0, width=0.2)
    """
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
