"""Light that is not the same everywhere on an image: weaker, and on request of another tint, at one end.

The light of a pixel is that of the image times, in each channel,

    (1 − w) + w · end,        0 < end ≤ 1,

where w, 0 … 1, is the mask of a second light (`generator.masks`), drawn anew for each image. So nowhere is it brighter
than the light that was photographed, and noise can always be added to what it was. The end is 2 to the power of minus
some stops, times the tint where one is asked for.

Where the end has no tint, the chromaticity of the light is the same in every pixel, and the ground truth is that of the
light. With a tint the image has two lights of one name, and masks and maps as other images of several lights have.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from foundation.errors import InputError
from generator import philox
from generator.masks.making import MadeMasks
from generator.masks.request import parse_shape
from generator.masks.shapes import RandomStreams, Shape, SmoothFields
from generator.masks.weights import Weights
from generator.named_numbers import Range, parse_numbers

Three = tuple[float, float, float]

_OPTIONS: Final[dict[str, Range]] = {"stops": (0.0, 6.0), "least": (0.0, 6.0), "colour": (0.0, 1.0)}


@dataclass(frozen=True)
class Falloff:
    """The uneven light of one image.

    - `masks`: (height, width, 2) weights of the light itself, and of its far end.
    - `end`: red, green and blue light at the far end over that of the image, above 0 up to 1.
    """

    masks: MadeMasks
    end: Three

    def weights(self, height: int, width: int) -> Weights:
        """Return (height, width, 2) float32 from 0 to 1 in whole 65535ths that sum to 1 in every pixel."""
        return self.masks.weights(height, width, 2)


@dataclass(frozen=True)
class Gradient:
    """How light falls off on each image.

    - `shape`: where, as of the masks of two lights.
    - `stops`, `least`: the far end is darker by a number of stops between `least` and `stops`, each as likely.
    - `colour`: most that ln(R/G) and ln(B/G) of the far end differ from those of the light, each drawn evenly and on
      its own.
    """

    shape: Shape = SmoothFields()  # noqa: RUF009  frozen
    stops: float = 1.0
    least: float = 0.0
    colour: float = 0.0

    def __post_init__(self) -> None:
        if not (0 <= self.least <= self.stops < math.inf and 0 <= self.colour < math.inf):
            raise InputError(
                f"a gradient of {self.least:g} to {self.stops:g} stops and colour {self.colour:g} was asked for; "
                "expected rising stops from 0, and a colour from 0"
            )

    def of_image(self, seed: int, number: int) -> Falloff:
        """Return the uneven light of image `number`: words of Philox with counter (0, 64, number, 13), masks below."""
        drawn = [(int(word) + 0.5) / (1 << 32) for word in philox.words(seed, 0, 64, number, philox.GRADIENTS)]
        level = 2.0 ** -(self.least + (self.stops - self.least) * drawn[0])
        red, blue = (math.exp(self.colour * (2 * place - 1)) for place in drawn[1:3])
        most = max(red, 1.0, blue)
        end = (level * red / most, level / most, level * blue / most)
        return Falloff(MadeMasks(self.shape, RandomStreams(seed, number, philox.GRADIENTS)), end)

    def describe(self) -> dict[str, Any]:
        """Return the shape and the numbers as plain values."""
        return {**self.shape.describe(), "stops": self.stops, "least": self.least, "colour": self.colour}


def described_gradient(record: Mapping[str, Any]) -> Gradient:
    """Return the gradient that `Gradient.describe` described.

    Examples
    --------
    >>> described_gradient(Gradient(stops=2.0).describe()) == Gradient(stops=2.0)
    True
    """
    kind = str(record.get("masks"))
    # A half plane is a soft edge of no width, which only its name says.
    given = {name: value for name, value in record.items() if name != "masks" and value is not None}
    if kind == "half-plane":
        given.pop("width", None)
    return parse_gradient(f"{kind}:{','.join(f'{name}={value}' for name, value in given.items())}")


def parse_gradient(text: str) -> Gradient:
    """Return the gradient that a text names: a kind of masks with its numbers, and ``stops``, ``least``, ``colour``.

    Examples
    --------
    >>> parse_gradient("soft-edge:width=.8,stops=2").stops
    2.0
    """
    kind, _, rest = text.strip().partition(":")
    entries = [entry for entry in rest.split(",") if entry.strip()]
    own = [entry for entry in entries if entry.partition("=")[0].strip().lower() in _OPTIONS]
    numbers = parse_numbers(",".join(own), _OPTIONS, f"the gradient {kind}")
    others = ",".join(entry for entry in entries if entry not in own)
    shape = parse_shape(f"{kind}:{others}" if others else kind)
    stops = numbers.get("stops", max(Gradient.stops, numbers.get("least", 0.0)))
    return Gradient(shape, stops, numbers.get("least", Gradient.least), numbers.get("colour", Gradient.colour))
