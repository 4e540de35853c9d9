"""Which lights fall on which source picture.

Every picture under the same listed lights, each under some drawn at random from the table or from a distribution, or
each under the light of a ground truth of another data set (paper, section 4.3), the nearest of the table or one mixed
to match; one at a time, or several together, each in its part of the picture. A choice depends on the picture's
position in the list of sources and on a seed, and on nothing else.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
import numpy.typing as npt

from foundation.errors import InputError, first_few, nearest_names, value_text
from generator import philox
from generator.kernels.rendering import valid_light
from generator.lights.distributions import Distribution
from generator.lights.gamut import TOLERANCE_DEG, Gamut, Match, OutsideGamut, black_body, rgb_of
from generator.lights.lighting import LightChoice, Lighting, ListedLights, Mixture, parse_mixture, plain
from generator.masks.making import MaskPlan
from generator.named_numbers import parse_numbers

if TYPE_CHECKING:
    from calibration.table.lut import Lut

# Chromaticities drawn at a time: one of them lies in the gamut for all but narrow gamuts, and numpy is used well.
_BATCH: Final = 32
# Batches drawn at most for a light: 65 536 draws, of which none is in the gamut with probability e⁻⁶⁵ where a share
# of `_LEAST_WITHIN` is.
_BATCHES: Final = 2048
# Share of a distribution that must lie in the gamut; with less, a light would take thousands of draws.
_LEAST_WITHIN: Final = 1e-3
# Angle, degrees, to the nearest light of the table beyond which a ground truth is far: more than the errors of good
# methods, which are 2 degrees, so that the light taken would be another one than was asked for.
_FAR_DEG: Final = 3.0
# Share of far ground truths with which a file does not fit the table: edges of a data set may lie outside, not much of
# it. So far are channels in another order and lights of another camera, unless the table makes nearly every light.
_MOST_FAR: Final = 0.25
_MOST_DEG: Final = 10.0  # Angle to the nearest light of the table that no ground truth of a table's camera has


@dataclass(frozen=True)
class SequentialLights:
    """The lights of a list of ground truths one after another, `each` for a picture, starting over when it ends.

    - `method`: how a light was found for a ground truth: the ``nearest`` of the table, or a mixture to ``match`` it.
    - `matches`: for each ground truth the light, and its angle to it.
    - `file`: name of the file that they come from.
    - `lights_each`: images for each picture.
    """

    method: Literal["nearest", "match"]
    matches: tuple[Match, ...]
    file: str
    lights_each: int = 1

    def lightings_of(self, position: int) -> tuple[Lighting, ...]:
        """Return the lighting of each image of the picture at `position`."""
        first = position * self.lights_each
        return tuple(
            Lighting((self.matches[number % len(self.matches)].mixture,))
            for number in range(first, first + self.lights_each)
        )

    def describe(self) -> dict[str, Any]:
        """Return the choice as plain values."""
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
        """How many ground truths the lights found do not make."""
        return sum(match.angle > TOLERANCE_DEG for match in self.matches)

    @property
    def largest_deg(self) -> float:
        """Largest angle of a light to its ground truth, degrees."""
        return max(match.angle for match in self.matches)


@dataclass(frozen=True, eq=False)
class DrawnLights:
    """Lights for each picture, drawn from a distribution cut to what the table can make; purpose 4 of `philox`.

    Light j of the picture at position p is the first of the draws 0, 1, 2 … that lies in the gamut, draw i made of
    the words of place (i, j), number p.
    """

    gamut: Gamut
    distribution: Distribution
    lights_each: int
    seed: int

    def __post_init__(self) -> None:
        if self.lights_each < 1:
            raise InputError(f"{self.lights_each} lights a picture were asked for, expected 1 or more")
        within = np.mean([self._batch(trial, 0, 0)[1].mean() for trial in range(128)])
        if within < _LEAST_WITHIN:
            raise InputError(
                f"{within:.1%} of the distribution lies within what {self.gamut.table} can make, expected "
                f"{_LEAST_WITHIN:.1%} or more; choose one nearer to its lights, whose mean is "
                "r={:.3f}, b={:.3f}".format(*self.gamut.rb.mean(axis=0))
            )

    def lightings_of(self, position: int) -> tuple[Lighting, ...]:
        """Return the lighting of each image of the picture at `position`."""
        return tuple(Lighting((self._light(position, light),)) for light in range(self.lights_each))

    def describe(self) -> dict[str, Any]:
        """Return the choice as plain values."""
        return {"choice": "drawn", "count": self.lights_each, **self.distribution.describe()}

    def _light(self, position: int, light: int) -> Mixture:
        for batch in range(_BATCHES):
            drawn, within = self._batch(batch, light, position)
            if within.any():
                return self.gamut.match(rgb_of(drawn[int(within.argmax())])).mixture
        raise InputError(f"{_BATCH * _BATCHES} draws from the distribution all lie outside {self.gamut.table}")

    def _batch(self, batch: int, light: int, position: int) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.bool_]]:
        places = np.arange(batch * _BATCH, (batch + 1) * _BATCH)
        words = philox.words(self.seed, places, light, position, philox.CHROMATICITIES)
        drawn = self.distribution.draw(words)
        return drawn, self.gamut.contains(drawn)


@dataclass(frozen=True)
class SimultaneousLights:
    """`together` lights of another choice at a time on one image, each where the masks let it fall.

    Image i of a picture gets the lights i · together … of the other choice, and the masks of number
    position · images + i.
    """

    choice: LightChoice
    together: int
    masks: MaskPlan

    def __post_init__(self) -> None:
        if self.together < 2 or self.choice.lights_each % self.together:
            raise InputError(
                f"lights for each picture: {self.choice.lights_each}, lights in an image: {self.together}; expected 2 "
                "or more in an image, and a multiple of these for each picture: repeat --light, or give --random"
            )

    @property
    def lights_each(self) -> int:
        """Images for each picture."""
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

    def describe(self) -> dict[str, Any]:
        """Return the choice as plain values."""
        return {
            "choice": "together",
            "together": self.together,
            "masks": self.masks.describe(),
            "lights": self.choice.describe(),
        }


def parse_lights(texts: Iterable[str], lut: Lut) -> ListedLights:
    """Return the lights of several texts: each is a list as `light_numbers` reads it, or one light of `parse_light`."""
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
    """Return the lights of a list such as `0,5,12-20`, or `all`; each once, in the order written."""
    if text.strip().lower() == "all":
        return tuple(range(total))
    lights: dict[int, None] = {}
    for entry in text.split(","):
        match = re.fullmatch(r"\s*(\d+)\s*(?:-\s*(\d+)\s*)?", entry, re.ASCII)
        if not match:
            raise InputError(f"{entry.strip()!r} is no light; write numbers and ranges as in 0,5,12-20, or all")
        first = int(match[1])
        last = int(match[2]) if match[2] else first
        if max(first, last) >= total:
            raise InputError(f"there is no light {max(first, last)}; the table has lights 0 to {total - 1}")
        if last < first:
            raise InputError(f"{entry.strip()!r} runs backwards; write {last}-{first}")
        lights.update(dict.fromkeys(range(first, last + 1)))
    return tuple(lights)


_LEAST_K: Final = 1000  # From here on a number is rather a temperature in kelvin than that of a light

# White balances that cameras name, kelvin, as manuals of EOS bodies have them.
_WHITE_BALANCES: Final = {"sunny": 5200, "daylight": 5200, "shade": 7000, "cloudy": 6000, "tungsten": 3200}


def _no_light(text: str, names: Sequence[str]) -> str:
    known = _WHITE_BALANCES.get(text.lower())
    near = f"write {known}K for a black body like it" if known else nearest_names(text, names)
    usual = "write a light such as 12, 12:0.25+40:0.75, 5600K or r=.3,b=.25"
    of_these = f", or a name: {first_few(names)}" if names else ""
    return f"{text!r} is no light; {near or usual + of_these}"


def parse_light(text: str, lut: Lut, gamut: Gamut | None = None, outside: OutsideGamut = "refuse") -> Mixture:
    """Return the light that a text names.

    ``12`` and ``12:0.25+40:0.75`` are lights of the table, as is a name (``D65``) where they have names, ``cct=4500``
    or ``4500K`` a black body in kelvin (`lights.gamut.black_body`), ``r=.3,b=.25`` a chromaticity in linear RGB of the
    table's camera.
    """
    named = {light.name: light.index for light in lut.illuminations if light.name is not None}
    if text.strip() in named:
        return plain(named[text.strip()])
    kelvin = re.fullmatch(r"(\d+(?:\.\d*)?)\s*[kK]", text.strip(), re.ASCII)
    if kelvin:
        text = f"cct={kelvin[1]}"
    if "=" not in text:
        try:
            mixture = parse_mixture(text.strip())
        except InputError as error:
            raise InputError(_no_light(text.strip(), list(named))) from error
        if len(mixture.lights) == 1 and mixture.lights[0] >= max(_LEAST_K, len(lut.white)):
            raise InputError(
                f"there is no light {text.strip()}; the table has lights 0 to {len(lut.white) - 1}; write "
                f"{text.strip()}K for the black body of that temperature"
            )
        mixture.white(lut)
        return mixture
    numbers = parse_numbers(
        text, {"cct": (1.0, 1e6), "r": (0.0, 1.0), "b": (0.0, 1.0)}, "a light, cct=4500 or r=.3,b=.25"
    )
    if numbers.keys() == {"cct"}:
        return black_body(lut, numbers["cct"])
    if numbers.keys() != {"r", "b"}:
        raise InputError(f"{text!r} is no light; write cct=4500, or both r and b, such as r=.3,b=.25")
    total = numbers["r"] + numbers["b"]
    if total > 1:
        red, blue = (f"{math.floor(100 * numbers[name] / total) / 100:g}" for name in "rb")
        raise InputError(
            f"{text!r} is no light: r, g and b sum to 1, and r and b to {total:g} already; such a light without green "
            f"is r={red},b={blue}"
        )
    return (gamut or Gamut.of(lut)).match(rgb_of([numbers["r"], numbers["b"]]), outside).mixture


def light_of(given: int | str | Mixture, lut: Lut) -> Mixture:
    """Return a light that is given by its number in the table, by a text that `parse_light` reads, or as a mixture."""
    if isinstance(given, str):
        return parse_light(given, lut)
    if isinstance(given, Mixture):
        given.white(lut)
        return given
    return plain(valid_light(lut, given))


def listed_lights(given: Iterable[int | str | Mixture] | str | float | Mixture, lut: Lut) -> ListedLights:
    """Return the same lights for every picture, each given as `light_of` takes it."""
    if isinstance(given, str | int | float | Mixture):
        raise InputError(f"the lights are {value_text(given)}, expected a list, such as [0, 3] or ['D65']")
    # Numbers stay numbers: a dataset is the same by whatever way its lights were given.
    return ListedLights(
        tuple(light_of(light, lut) if isinstance(light, str | Mixture) else valid_light(lut, light) for light in given)
    )


def nearest_lights(lut: Lut, truths: npt.NDArray[np.float64], file: str = "", each: int = 1) -> SequentialLights:
    """Return for each ground truth the table's light at the smallest angle; of several the lowest number.

    `truths`: (N, 3) float64 ≥ 0, linear RGB of the table's camera, of any length.
    """
    table = lut.ground_truth / np.linalg.norm(lut.ground_truth, axis=1, keepdims=True)
    wanted = truths / np.linalg.norm(truths, axis=1, keepdims=True)
    cosine = np.clip(wanted @ table.T, -1.0, 1.0)
    lights = cosine.argmax(axis=1)
    angles = np.degrees(np.arccos(cosine[np.arange(len(lights)), lights]))
    matches = (Match(plain(int(light)), float(angle)) for light, angle in zip(lights, angles, strict=True))
    return SequentialLights("nearest", tuple(matches), file, each)


def matched_lights(
    gamut: Gamut, truths: Mapping[int, Sequence[float]], file: str = "", each: int = 1
) -> SequentialLights:
    """Return for each ground truth the mixture of the table's lights that has it, or the nearest that there is.

    An InputError says that too many ground truths are far from what the table can make, or one is very far.

    `truths`: by their lines in the file, linear RGB ≥ 0 of the table's camera, of any length. See `gamut.Gamut.match`.
    """
    choice = SequentialLights("match", tuple(gamut.match(truth, "nearest") for truth in truths.values()), file, each)
    far = [line for line, match in zip(truths, choice.matches, strict=True) if match.angle > _FAR_DEG]
    if len(far) > _MOST_FAR * len(truths) or choice.largest_deg > _MOST_DEG:
        raise InputError(
            f"{len(far)} of the {len(truths)} ground truths of {file} lie more than {_FAR_DEG:g} degrees outside what "
            f"{gamut.table} can make, up to {choice.largest_deg:.2f} degrees, the first in line {far[0]}; expected at "
            f"most {_MOST_FAR:.0%}, and none beyond {_MOST_DEG:g} degrees: see that the channels are in the order R, "
            "G, B and the file is of the table's camera, or take a table with a wider gamut"
        )
    return choice


def light_notes(choice: LightChoice) -> tuple[str, ...]:
    """Return a sentence about the ground truths that the table cannot make; none if it makes all."""
    if isinstance(choice, SimultaneousLights):
        return light_notes(choice.choice)
    if not isinstance(choice, SequentialLights) or choice.method != "match":
        return ()
    if not choice.outside:
        return ()
    return (
        f"{choice.outside} of the {len(choice.matches)} lights of {choice.file} lie outside what the table can make, "
        f"up to {choice.largest_deg:.2f} degrees; the nearest that it can make are taken, and are the ground truth",
    )
