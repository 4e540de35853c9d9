"""Scenes generated in memory: what `generate` would write, without a data set on the disk.

Image number i of a set shows source i under the i-th light that was chosen. Its samples are chosen as `generate` with
the same seed chooses them, so a set that is worth keeping can be written by that command, to the same numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from foundation.errors import InputError
from generator.lights.choices import RandomLights, nearest_lights
from generator.pictures.sources import Source, SourcePicture

if TYPE_CHECKING:
    from generator import Lut


@dataclass(frozen=True, eq=False)
class RenderedScene:
    """A picture printed, lit by a light of a table, and photographed.

    - `light`: number of the light in the table.
    - `number`: the image's number in its set.
    - `seed`: 0 … 2⁶⁴ − 1; chooses the samples.
    """

    lut: Lut
    source: Source
    light: int
    number: int
    seed: int = 0

    @property
    def name(self) -> str:
        """The image's number, as in the names of files that `generate` writes."""
        return f"{self.number:06d}"

    @property
    def truth(self) -> npt.NDArray[np.float64]:
        """The light (3,) float64, linear camera RGB, r + g + b = 1."""
        return self.lut.ground_truth[self.light]

    @property
    def saturation(self) -> float:
        """White level of the table, in the units of the image."""
        return float(self.lut.provenance.white_level)

    def read(self) -> tuple[npt.NDArray[np.uint16], None]:
        """Return the image (H, W, 3) uint16, linear camera RGB, and no mask."""
        from generator import render

        return render(self.lut, self.source.read().picture, self.light, seed=self.seed, image=self.number), None


@dataclass(frozen=True, eq=False)
class ScaledSource:
    """A picture scaled to a longest side, up or down.

    `side`: longest side, px.
    """

    source: Source
    side: int

    @property
    def name(self) -> str:
        """The picture's name."""
        return self.source.name

    def to_json(self) -> dict[str, Any]:
        """Return how the picture is made, as a JSON object."""
        return {**self.source.to_json(), "side": self.side}

    def read(self) -> SourcePicture:
        """Return the picture, codes (H, W, 3) uint8: smaller by the mean of areas, larger by linear interpolation."""
        import cv2

        picture = self.source.read().picture
        height, width = picture.shape[:2]
        scale = self.side / max(height, width)
        size = (max(1, round(width * scale)), max(1, round(height * scale)))
        how = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
        return SourcePicture(np.asarray(cv2.resize(picture, size, interpolation=how), dtype=np.uint8))


@dataclass(frozen=True)
class ChosenLights:
    """A light of a table for each image.

    - `numbers`: the light of each image.
    - `how`: how they were chosen, in words.
    """

    numbers: tuple[int, ...]
    how: str


def lights_like(lut: Lut, truths: npt.NDArray[np.float64], count: int) -> ChosenLights:
    """Return for each of `count` images the light nearest to its ground truth, of another camera or not.

    `truths`: (N, 3) float64 ≥ 0, linear camera RGB of any length; image i has truth i mod N.
    """
    matches = nearest_lights(lut, truths).matches
    numbers = tuple(matches[image % len(matches)].mixture.lights[0] for image in range(count))
    used = matches[:count]
    angles = np.array([match.angle for match in used])
    among = f"the first {len(used)} of {len(truths)}" if len(used) < len(truths) else f"{len(truths)}"
    return ChosenLights(
        numbers,
        f"nearest by angle to {among} ground truths, {len(set(numbers))} different lights; angle to them "
        f"{np.median(angles):.2f}° in the median, {angles.max():.2f}° at most",
    )


def lights_at_random(lut: Lut, count: int, seed: int) -> ChosenLights:
    """Return for each of `count` images a light drawn from all of the table, as `generate --random 1` does."""
    choice = RandomLights(1, len(lut.white), seed)
    numbers = tuple(choice.lightings_of(image)[0].mixtures[0].lights[0] for image in range(count))
    return ChosenLights(
        numbers, f"drawn from all {len(lut.white)} lights with seed {seed}, {len(set(numbers))} different"
    )


def rendered(lut: Lut, sources: Sequence[Source], lights: ChosenLights, seed: int = 0) -> tuple[RenderedScene, ...]:
    """Return the scenes of pictures under the lights chosen for them."""
    if len(sources) != len(lights.numbers):
        raise InputError(f"{len(sources)} pictures have {len(lights.numbers)} lights, expected one each")
    pairs = zip(sources, lights.numbers, strict=True)
    return tuple(RenderedScene(lut, source, light, number, seed) for number, (source, light) in enumerate(pairs))
