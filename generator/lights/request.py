"""The options of light, as they are written on a command line, and the choice of lights that they ask for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from foundation.errors import InputError
from generator.lights.choices import (
    DrawnLights,
    ListedLights,
    RandomLights,
    SimultaneousLights,
    matched_lights,
    nearest_lights,
    parse_light,
    parse_lights,
)
from generator.lights.distributions import parse_distribution
from generator.lights.gamut import Gamut, OutsideGamut
from generator.lights.ground_truths import load_ground_truths
from generator.lights.lighting import LightChoice
from generator.lights.named_lights import load_named_truths, named_lights
from generator.masks.request import parse_masks

if TYPE_CHECKING:
    from calibration.table.lut import Lut

MASKS: Final = "smooth"
"""The masks of several lights where none are named."""


@dataclass(frozen=True)
class LightRequest:
    """The options of light, each None or empty where it was not given; named as on the command line.

    - `illuminations`: lights of the table for every picture: ``0,5,12-20`` or ``all``.
    - `light`: lights for every picture, each as `choices.parse_light` reads it.
    - `random`: images of each picture under lights of its own: of the table, or of `distribution`. One if None.
    - `distribution`: where those lights are drawn from; see `lights.distributions.parse_distribution`.
    - `nearest`, `match`: files of ground truths, for which the table's nearest lights are taken, or mixtures that match
      them.
    - `lights_by_name`: file of ground truths of each picture by its name, which mixtures match.
    - `outside`: what to do about chromaticities that the table cannot make.
    - `lights_per_image`: lights that fall on one image: that many, in the order of the lists, share each image.
    - `masks`: where each falls; see `masks.request.parse_masks`.
    """

    illuminations: str | None = None
    light: tuple[str, ...] = ()
    random: int | None = None
    distribution: str | None = None
    nearest: Path | None = None
    match: Path | None = None
    lights_by_name: Path | None = None
    outside: OutsideGamut = "refuse"
    lights_per_image: int | None = None
    masks: str | None = None

    def choose(self, lut: Lut, seed: int, names: Sequence[str] = (), crops: int = 1) -> LightChoice:
        """Return the choice of lights."""
        together = self.lights_per_image or (1 if self.masks is None else 2)
        if self.lights_per_image is not None and self.lights_per_image < 1:
            raise InputError(f"{self.lights_per_image} lights an image were asked for, expected 1 or more")
        if self.masks is not None and together == 1:
            raise InputError(
                f"--masks {self.masks} says where several lights fall, but each image has one; ask for more with "
                "--lights-per-image"
            )
        choice = self._lights(lut, seed, together, names, crops)
        if together == 1:
            return choice
        return SimultaneousLights(choice, together, parse_masks(self.masks or MASKS, together, seed))

    def _lights(self, lut: Lut, seed: int, together: int, names: Sequence[str], crops: int) -> LightChoice:
        """Return the choice of lights with as many for each picture as its images have together."""
        choices = {
            "--illuminations": self.illuminations is not None,
            "--light": bool(self.light),
            "--nearest": self.nearest is not None,
            "--match": self.match is not None,
            "--lights-by-name": self.lights_by_name is not None,
            "--distribution": self.distribution is not None,
            "--random": self.random is not None and self.distribution is None,
        }
        given = [name for name, is_given in choices.items() if is_given]
        if len(given) > 1:
            raise InputError(
                f"{' and '.join(given)} were both given; give one of them (only --random may go with --distribution)"
            )
        count = together * (1 if self.random is None else self.random)
        if self.illuminations is not None:
            return parse_lights(self.illuminations, len(lut.white))
        if self.light:
            gamut = Gamut.of(lut)
            return ListedLights(tuple(parse_light(text, lut, gamut, self.outside) for text in self.light))
        if self.nearest is not None:
            return nearest_lights(lut, load_ground_truths(self.nearest), self.nearest.name, together)
        if self.match is not None:
            truths = load_ground_truths(self.match)
            return matched_lights(Gamut.of(lut), truths, self.match.name, together, self.outside)
        if self.lights_by_name is not None:
            truths_by_name, file = load_named_truths(self.lights_by_name), self.lights_by_name.name
            return named_lights(Gamut.of(lut), truths_by_name, names, file, self.outside, crops)
        if self.distribution is not None:
            return DrawnLights(Gamut.of(lut), parse_distribution(self.distribution), count, seed)
        return RandomLights(count, len(lut.white), seed)
