"""Choose the illuminants of each source picture, and read illuminants from text.

A `LightChoice` returns the illuminants of a picture. They depend only on the position of the picture in the list of
sources and on a seed. Illuminants are listed by the user, drawn from the look-up table (LUT) or from a distribution, or
they match the ground truths of another data set (paper, section 4.3).
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
import numpy.typing as npt

from foundation.errors import InputError, first_few, nearest_names, value_text
from generator import philox
from generator.kernels.rendering import valid_light
from generator.lights.distributions import Distribution
from generator.lights.gamut import TOLERANCE_DEG, Gamut, Match, OutsideGamut, black_body, rgb_of
from generator.lights.lighting import LightChoice, Lighting, ListedLights, Mixture, parse_mixture, single_mixture
from generator.masks.making import GivenMaskPlan, MaskPlan
from generator.named_numbers import parse_numbers

if TYPE_CHECKING:
    from calibration.table.lut import Lut

# Chromaticities are drawn in batches of this size. Usually at least one of a batch is in the gamut.
_BATCH: Final = 32
# Largest number of batches for one illuminant: 65 536 draws. Even for the smallest allowed share in the gamut,
# `_LEAST_WITHIN`, all draws are outside only with the probability e⁻⁶⁵.
_BATCHES: Final = 2048
# Smallest allowed share of a distribution in the gamut. With less, an illuminant would need thousands of draws.
_LEAST_WITHIN: Final = 1e-3
# A ground truth is far if its angle to the nearest mixture exceeds this value, in degrees. Errors of good methods are
# smaller, about 2 degrees.
_FAR_DEG: Final = 3.0
# A file is refused if a larger share of its ground truths is far. A few unusual illuminants may be far. Many
# indicate another order of the channels or another camera.
_MOST_FAR: Final = 0.25
_MOST_DEG: Final = 10.0  # Largest angle in degrees for a ground truth of the same camera


@dataclass(frozen=True)
class SequentialLights:
    """Illuminants that match a list of ground truths, used in order and repeated if the list is too short."""

    method: Literal["nearest", "match"]  # nearest illuminant of the LUT, or a mixture that matches
    matches: tuple[Match, ...]  # for each ground truth
    file: str  # name of the file of the ground truths
    lights_each: int = 1  # images of each picture

    def lightings_of(self, position: int) -> tuple[Lighting, ...]:
        """Return the lighting of each image of the picture at `position`."""
        first = position * self.lights_each
        return tuple(
            Lighting((self.matches[number % len(self.matches)].mixture,))
            for number in range(first, first + self.lights_each)
        )

    def describe(self) -> dict[str, Any]:
        """Return the choice as plain values for `dataset.json`."""
        described: dict[str, Any] = {
            "choice": self.method,
            "file": self.file,
            "each": self.lights_each,
            "lights": [match.mixture.label for match in self.matches],
        }
        if self.method == "match":
            described["outside"] = {"count": self.outside, "largest_deg": round(self.largest_deg, 3)}
        return described

    @property
    def outside(self) -> int:
        """Number of ground truths outside the gamut of the LUT."""
        return sum(match.angle > TOLERANCE_DEG for match in self.matches)

    @property
    def largest_deg(self) -> float:
        """Largest angle between an illuminant and its ground truth, degrees."""
        return max(match.angle for match in self.matches)


@dataclass(frozen=True, eq=False)
class DrawnLights:
    """Illuminants for each picture, drawn from a distribution within the gamut of the LUT.

    Illuminant j of the picture at position p is made from the first of the draws 0, 1, 2 … that is in the gamut. Draw i
    uses the words of `philox` with counter (i, j, p, 4).
    """

    gamut: Gamut
    distribution: Distribution
    lights_each: int
    seed: int

    def __post_init__(self) -> None:
        if self.lights_each < 1:
            raise InputError(f"illuminants of each picture: {self.lights_each}, expected 1 or more; correct it")
        inside = np.mean([self._batch(trial, 0, 0)[1].mean() for trial in range(128)])
        if inside < _LEAST_WITHIN:
            raise InputError(
                f"{inside:.1%} of the distribution is in the gamut of {self.gamut.table}, expected {_LEAST_WITHIN:.1%} "
                f"or more; choose a distribution nearer to the illuminants, which have the mean "
                "r={:.3f}, b={:.3f}".format(*self.gamut.rb.mean(axis=0))
            )

    def lightings_of(self, position: int) -> tuple[Lighting, ...]:
        """Return the lighting of each image of the picture at `position`."""
        return tuple(Lighting((self._light(position, light),)) for light in range(self.lights_each))

    def describe(self) -> dict[str, Any]:
        """Return the choice as plain values for `dataset.json`."""
        return {"choice": "drawn", "count": self.lights_each, **self.distribution.describe()}

    def _light(self, position: int, light: int) -> Mixture:
        for batch in range(_BATCHES):
            drawn, is_inside = self._batch(batch, light, position)
            if is_inside.any():
                return self.gamut.match(rgb_of(drawn[int(is_inside.argmax())])).mixture
        raise InputError(f"{_BATCH * _BATCHES} draws are all outside {self.gamut.table}; choose another distribution")

    def _batch(self, batch: int, light: int, position: int) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.bool_]]:
        draw_numbers = np.arange(batch * _BATCH, (batch + 1) * _BATCH)
        words = philox.words(self.seed, draw_numbers, light, position, philox.CHROMATICITIES)
        drawn = self.distribution.draw(words)
        return drawn, self.gamut.contains(drawn)


@dataclass(frozen=True)
class SimultaneousLights:
    """Several illuminants of another choice in each image, combined by masks.

    For each picture, `choice` has a list of illuminants. Image i of the picture gets the next `together` of them, from
    index i · together on. The masks are those of image number position · lights_each + i.
    """

    choice: LightChoice
    together: int  # illuminants in each image
    masks: MaskPlan

    def __post_init__(self) -> None:
        if self.together < 2 or self.choice.lights_each % self.together:
            raise InputError(
                f"{self.choice.lights_each} illuminants for each picture and {self.together} in each image, expected 2 "
                "or more in an image and a multiple of this for each picture; repeat --light, or use --random"
            )

    @property
    def lights_each(self) -> int:
        """Images of each picture."""
        return self.choice.lights_each // self.together

    def lightings_of(self, position: int) -> tuple[Lighting, ...]:
        """Return the lighting of each image of the picture at `position`."""
        mixtures = [mixture for lighting in self.choice.lightings_of(position) for mixture in lighting.mixtures]
        return tuple(
            Lighting(
                tuple(mixtures[image * self.together : (image + 1) * self.together]),
                self.masks.maker(position * self.lights_each + image),
            )
            for image in range(self.lights_each)
        )

    def paired(self, pictures: Sequence[str], crops: int) -> SimultaneousLights:
        """Return the choice with masks from files assigned to the pictures, of which each has `crops` crops."""
        if not isinstance(self.masks, GivenMaskPlan):
            return self
        return replace(self, masks=self.masks.paired(pictures, crops * self.lights_each))

    def describe(self) -> dict[str, Any]:
        """Return the choice as plain values for `dataset.json`."""
        return {
            "choice": "together",
            "together": self.together,
            "masks": self.masks.describe(),
            "lights": self.choice.describe(),
        }


def parse_lights(texts: Iterable[str], lut: Lut) -> ListedLights:
    """Return the illuminants of several texts, each for `light_numbers` or `parse_light`."""
    gamut, lights = Gamut.of(lut), list[int | Mixture]()
    for text in texts:
        is_number = re.fullmatch(r"\s*\d+\s*", text, re.ASCII)
        if not is_number and re.fullmatch(r"[\d\s,-]+|\s*all\s*", text, re.ASCII | re.IGNORECASE):
            lights += light_numbers(text, len(lut.white))
        else:
            mixture = parse_light(text, lut, gamut)
            lights.append(mixture.lights[0] if is_number else mixture)
    return ListedLights(tuple(lights))


def light_numbers(text: str, total: int) -> tuple[int, ...]:
    """Return the numbers in a list such as `0,5,12-20` or `all`, in this order and without repetitions."""
    if text.strip().lower() == "all":
        return tuple(range(total))
    lights: dict[int, None] = {}
    for entry in text.split(","):
        match = re.fullmatch(r"\s*(\d+)\s*(?:-\s*(\d+)\s*)?", entry, re.ASCII)
        if not match:
            raise InputError(
                f"{entry.strip()!r} is not an illuminant; write numbers and ranges as in 0,5,12-20, or all"
            )
        first = int(match[1])
        last = int(match[2]) if match[2] else first
        if max(first, last) >= total:
            raise InputError(f"the LUT has no illuminant {max(first, last)}, expected 0 to {total - 1}; correct it")
        if last < first:
            raise InputError(f"the range {entry.strip()!r} is reversed; write {last}-{first}")
        lights.update(dict.fromkeys(range(first, last + 1)))
    return tuple(lights)


_LEAST_K: Final = 1000  # A number from this value on is probably a colour temperature in kelvin

# White balance settings of cameras in kelvin, from the manuals of EOS cameras.
_WHITE_BALANCES: Final = {"sunny": 5200, "daylight": 5200, "shade": 7000, "cloudy": 6000, "tungsten": 3200}


def _unknown_light_message(text: str, names: Sequence[str]) -> str:
    kelvin = _WHITE_BALANCES.get(text.lower())
    near = f"write {kelvin}K for a similar black body" if kelvin else nearest_names(text, names)
    examples = "write an illuminant such as 12, 12:0.25+40:0.75, 5600K or r=0.3,b=0.25"
    name_examples = f", or a name: {first_few(names)}" if names else ""
    return f"{text!r} is not an illuminant; {near or examples + name_examples}"


def parse_light(text: str, lut: Lut, gamut: Gamut | None = None, outside: OutsideGamut = "refuse") -> Mixture:
    """Return the illuminant that a text specifies.

    Illuminants of the LUT are ``12``, ``12:0.25+40:0.75``, or a name such as ``D65`` if the LUT has names.
    ``cct=4500`` and ``4500K`` are black bodies (`lights.gamut.black_body`). ``r=0.3,b=0.25`` is a chromaticity in
    linear RGB of the camera of the LUT.
    """
    numbers_by_name = {light.name: light.index for light in lut.illuminations if light.name is not None}
    if text.strip() in numbers_by_name:
        return single_mixture(numbers_by_name[text.strip()])
    kelvin = re.fullmatch(r"(\d+(?:\.\d*)?)\s*[kK]", text.strip(), re.ASCII)
    if kelvin:
        text = f"cct={kelvin[1]}"
    if "=" not in text:
        try:
            mixture = parse_mixture(text.strip())
        except InputError as error:
            raise InputError(_unknown_light_message(text.strip(), list(numbers_by_name))) from error
        if len(mixture.lights) == 1 and mixture.lights[0] >= max(_LEAST_K, len(lut.white)):
            raise InputError(
                f"illuminant {text.strip()} is not in the LUT, expected 0 to {len(lut.white) - 1}; write "
                f"{text.strip()}K for the black body of that temperature"
            )
        mixture.white(lut)
        return mixture
    numbers = parse_numbers(text, {"cct": (1.0, 1e6), "r": (0.0, 1.0), "b": (0.0, 1.0)}, "an illuminant")
    if numbers.keys() == {"cct"}:
        return black_body(lut, numbers["cct"])
    if numbers.keys() != {"r", "b"}:
        raise InputError(f"{text!r} is not an illuminant; write cct=4500, or both r and b as in r=0.3,b=0.25")
    total = numbers["r"] + numbers["b"]
    if total > 1:
        red, blue = (f"{math.floor(100 * numbers[name] / total) / 100:g}" for name in "rb")
        raise InputError(f"{text!r}: r + b is {total:g}, expected at most 1; for g = 0 write r={red},b={blue}")
    return (gamut or Gamut.of(lut)).match(rgb_of([numbers["r"], numbers["b"]]), outside).mixture


def light_of(light: int | str | Mixture, lut: Lut) -> Mixture:
    """Return the mixture for an illuminant: for its number, for a text as in `parse_light`, or the mixture itself."""
    if isinstance(light, str):
        return parse_light(light, lut)
    if isinstance(light, Mixture):
        light.white(lut)
        return light
    return single_mixture(valid_light(lut, light))


def listed_lights(lights: Iterable[int | str | Mixture] | str | float | Mixture, lut: Lut) -> ListedLights:
    """Return a choice with these illuminants for every picture. Each is given as for `light_of`."""
    if isinstance(lights, str | int | float | Mixture):
        raise InputError(f"lights is {value_text(lights)}, expected a list such as [0, 3] or ['D65']; correct it")
    # Numbers stay numbers, so that `describe` returns the same record as for the command.
    return ListedLights(
        tuple(light_of(light, lut) if isinstance(light, str | Mixture) else valid_light(lut, light) for light in lights)
    )


def nearest_lights(lut: Lut, truths: npt.NDArray[np.float64], file: str = "", lights_each: int = 1) -> SequentialLights:
    """Return the illuminant of the LUT with the smallest angle to each ground truth; if equal, the lowest index.

    `truths` is (N, 3) float64 ≥ 0, linear RGB of the camera of the LUT, not necessarily normalised.
    """
    table = lut.ground_truth / np.linalg.norm(lut.ground_truth, axis=1, keepdims=True)
    targets = truths / np.linalg.norm(truths, axis=1, keepdims=True)
    cosine = np.clip(targets @ table.T, -1.0, 1.0)
    lights = cosine.argmax(axis=1)
    angles = np.degrees(np.arccos(cosine[np.arange(len(lights)), lights]))
    matches = (Match(single_mixture(int(light)), float(angle)) for light, angle in zip(lights, angles, strict=True))
    return SequentialLights("nearest", tuple(matches), file, lights_each)


def matched_lights(
    gamut: Gamut, truths: Mapping[int, Sequence[float]], file: str = "", lights_each: int = 1
) -> SequentialLights:
    """Return the mixture that matches each ground truth, or the nearest mixture (`Gamut.match`).

    `truths` maps line numbers of the file to linear RGB ≥ 0 of the camera of the LUT. Raises InputError if too many
    ground truths are far outside the gamut.
    """
    matches = tuple(gamut.match(truth, "nearest") for truth in truths.values())
    choice = SequentialLights("match", matches, file, lights_each)
    far = [line for line, match in zip(truths, choice.matches, strict=True) if match.angle > _FAR_DEG]
    if len(far) > _MOST_FAR * len(truths) or choice.largest_deg > _MOST_DEG:
        raise InputError(
            f"{len(far)} of the {len(truths)} ground truths of {file} are more than {_FAR_DEG:g} degrees outside the "
            f"gamut of {gamut.table}, by up to {choice.largest_deg:.2f} degrees (first in line {far[0]}), expected "
            f"at most {_MOST_FAR:.0%} of them, and no angle above {_MOST_DEG:g} degrees; check that the channels are "
            "in the order R, G, B and that the file belongs to the camera of the LUT, or use a LUT with a wider gamut"
        )
    return choice


def light_notes(choice: LightChoice) -> tuple[str, ...]:
    """Return a message about ground truths outside the gamut, if there are any."""
    if isinstance(choice, SimultaneousLights):
        return light_notes(choice.choice)
    if not isinstance(choice, SequentialLights) or choice.method != "match":
        return ()
    if not choice.outside:
        return ()
    return (
        f"{choice.outside} of the {len(choice.matches)} ground truths of {choice.file} are outside the gamut of the "
        f"LUT, by up to {choice.largest_deg:.2f} degrees; they are replaced by the nearest mixtures",
    )
