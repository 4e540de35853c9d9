"""The naive baseline: a picture's linear light times the colour of a light, beside what a table makes of it.

For each image of a generated data set a scene of the same picture under the same light, as bright and as finely
quantised, without a print, a camera or noise: codes become linear light by the sRGB curve, colours those of the camera
by its matrix if one is given, and each channel is multiplied by the light. What a learned method gains by training on
the generated image instead is what the table is worth. Several lights share the pixels of the counterpart by the masks
of the generated image, and light falls off as it does there. What `generate --exposure` and `--iso` did to the
generated image is not done to its counterpart.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from evaluation.datasets.generated import GeneratedScene
from evaluation.experiments.transfer.pictures import FoundPicture
from foundation.colorimetry import decode_srgb
from foundation.errors import FormatError, InputError
from generator.lights.lighting import parse_mixture
from generator.rendering.matrices import ColourMatrix
from generator.variation.variation import Falloff, described_gradient

_LINEAR: Final = decode_srgb(np.arange(256) / 255)
"""Linear light 0 … 1 of each code."""


def naive_image(
    codes: npt.NDArray[np.uint8],
    light: npt.NDArray[np.floating],
    saturation: float,
    matrix: npt.NDArray[np.float64] | None = None,
) -> npt.NDArray[np.uint16]:
    """Return the naive raw image of a picture under a light.

    `codes`: (H, W, 3) uint8, sRGB codes. `light`: (3,) or (H, W, 3) float, linear camera RGB that code 255, 255, 255 is
    to have, in counts. `matrix`: (3, 3) float64, linear sRGB to camera RGB with rows of sum 1; None leaves colours as
    they are. Returns (H, W, 3) uint16, rounded to whole counts, 0 … `saturation`.

    Examples
    --------
    >>> codes = np.array([[[255, 255, 255], [188, 0, 255]]], np.uint8)
    >>> naive_image(codes, np.array([1000.0, 2000.0, 500.0]), saturation=1800)
    array([[[1000, 1800,  500],
            [ 503,    0,  500]]], dtype=uint16)
    """
    linear = _LINEAR[codes]
    if matrix is not None:
        # A colour outside of what the camera tells apart would be darker than black.
        linear = np.maximum(linear @ matrix.T, 0)
    return np.clip(np.rint(linear * light), 0, np.floor(saturation)).astype(np.uint16)


@dataclass(frozen=True, eq=False)
class NaiveScene:
    """The naive counterpart of an image of a generated data set; made when it is read.

    - `generated`: the image whose counterpart it is.
    - `matrix`: the camera's colour matrix, or None.
    """

    generated: GeneratedScene
    picture: FoundPicture
    matrix: ColourMatrix | None = None

    @property
    def name(self) -> str:
        """The name of the generated image."""
        return self.generated.name

    @property
    def truth(self) -> npt.NDArray[np.float64]:
        """The light (3,) float64 of the generated image, linear camera RGB, r + g + b = 1."""
        return self.generated.truth

    @property
    def saturation(self) -> float:
        """The white level of the generated image, counts."""
        return self.generated.saturation

    @cached_property
    def whites(self) -> npt.NDArray[np.float64]:
        """The lights (K, 3) float64 of the image, counts of the table's white reference."""
        entry, description = self.generated.entry, self.generated.dataset.description
        levels = {light.illumination: sum(light.white) for light in description.lights}
        whites: list[npt.NDArray[np.float64]] = []
        for label, truth in zip(entry.lights, entry.truths, strict=True):
            mixture = parse_mixture(label)
            if not levels.keys() >= set(mixture.lights):
                raise FormatError(
                    f"{entry.image} is under light {label}, which its data set does not list; make it again"
                )
            level = sum(weight * levels[light] for light, weight in zip(mixture.lights, mixture.weights, strict=True))
            whites.append(np.array(truth) * level)
        end = [float(self._details.get(f"end_{channel}", 1)) for channel in "rgb"]
        if len(set(entry.lights)) == 1 and len(whites) == 2 and len(set(end)) > 1:
            # One light that falls off with a tint: the second is what is left of the first at the far end.
            whites[1] = whites[0] * end
        return np.array(whites)

    @cached_property
    def _falloff(self) -> Falloff | None:
        """How the image's light falls off without a tint, which is not among its lights; None if it does not."""
        description = self.generated.dataset.description
        variation: Any = description.options.get("variation", {})
        try:
            record = variation.get("gradient")
            gradient = None if record is None else described_gradient(record)
        except (InputError, AttributeError) as error:
            raise FormatError(
                f"the data set of {self.name} describes its variation as {variation}: {error}; make it again"
            ) from error
        if gradient is None or gradient.colour > 0:
            return None
        return gradient.of_image(description.seed, int(self.generated.entry.image.partition(".")[0]))

    @property
    def _details(self) -> Mapping[str, str]:
        """What options did to the generated image, by column of `images.csv`."""
        return self.generated.dataset.details.get(self.generated.entry.image, {})

    def read(self) -> tuple[npt.NDArray[np.uint16], None]:
        """Return the image (H, W, 3) uint16, counts, and no mask."""
        light = self.whites[0]
        if len(self.whites) > 1:
            light = self.generated.dataset.read_weights(self.generated.entry) @ self.whites
        matrix = None if self.matrix is None else self.matrix.rows
        codes = self.picture.codes(int(self._details.get("crop", 0)))
        if self._falloff is not None:
            far = self._falloff.weights(*codes.shape[:2])[..., 1:]
            light = light * (1 - far * (1 - self._falloff.end[1]))
        return naive_image(codes, light, self.saturation, matrix), None


@dataclass(frozen=True, eq=False)
class NaiveMixedScene(NaiveScene):
    """The naive counterpart of an image that several lights fall on."""

    @property
    def lights(self) -> npt.NDArray[np.float64]:
        """The lights (K, 3) float64, linear camera RGB, r + g + b = 1."""
        return np.array(self.generated.entry.truths)

    def read_weights(self) -> npt.NDArray[np.float32]:
        """Return the share of each light in each pixel: (H, W, K) float32, 0 … 1, sum 1."""
        return self.generated.dataset.read_weights(self.generated.entry)

    def read_truth_map(self) -> npt.NDArray[np.float32]:
        """Return the light of each pixel: (H, W, 3) float32, r + g + b = 1."""
        return self.generated.dataset.read_ground_truth_map(self.generated.entry)


def naive_scenes(
    scenes: Sequence[GeneratedScene], found: Mapping[str, FoundPicture], matrix: ColourMatrix | None = None
) -> tuple[NaiveScene, ...]:
    """Return the naive counterparts of generated images, in their order; images without a picture must be left out.

    `matrix`: the camera's colour matrix, or None.
    """
    return tuple(
        (NaiveScene if len(scene.entry.lights) == 1 else NaiveMixedScene)(scene, found[scene.entry.source], matrix)
        for scene in scenes
    )
