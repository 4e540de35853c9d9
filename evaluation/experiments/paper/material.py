"""What table 1 is made of: pictures, ground truths for lights like theirs, and scenes generated in memory.

Image number i of a set shows source i under the i-th light that was chosen. Its samples are chosen as `generate` with
the same seed chooses them, so a set that is worth keeping can be written by that command, to the same numbers.

Pictures come from real raw images whose light is known: sRGB codes as a raw converter would make them. The paper
prints "the sRGB images of the Canon 1Ds Mark III" (section 4.3), which the camera or a program of its maker
had developed; nobody has published how. Ours, with the ground truth at hand:

1. the image is divided by its light, green kept, and cut where the first channel clips, so that clipped skies become
   white and not pink (dcraw's ``-H 0``); thumbnails do not show what was clipped, and keep a few pink ones;
2. the camera's colour matrix takes it to linear sRGB (`generator.rendering.matrices`: white stays white);
3. it is scaled so that one in a hundred of the values of the channel that reaches highest lies above 1, dcraw's
   "99th-percentile white point", and cut to 0 … 1;
4. the curve of IEC 61966-2-1 and eight bits.

Ground truths come from a file of text, or from the data set itself.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from evaluation.datasets import open_scenes
from evaluation.scene import Image, Scene, SceneSet
from foundation.colorimetry import srgb_codes
from foundation.errors import FormatError, InputError
from generator import render
from generator.lights.choices import nearest_lights
from generator.lights.distributions import load_ground_truths
from generator.lights.lighting import RandomLights
from generator.pictures.sources import Source, SourcePicture
from generator.rendering.matrices import ColourMatrix

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
        # The publication's rendering.
        picture = self.source.read().picture
        image = render(self.lut, picture, self.light, rendering="codes", seed=self.seed, image=self.number)
        return image, None


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


def rendered(lut: Lut, sources: Sequence[Source], lights: ChosenLights, seed: int) -> tuple[RenderedScene, ...]:
    """Return the scenes of pictures under the lights chosen for them."""
    if len(sources) != len(lights.numbers):
        raise InputError(f"{len(sources)} pictures have {len(lights.numbers)} lights, expected one each")
    pairs = zip(sources, lights.numbers, strict=True)
    return tuple(RenderedScene(lut, source, light, number, seed) for number, (source, light) in enumerate(pairs))


WHITE_PERCENTILE: Final = 99.0  # Percentile that becomes white; dcraw's

_DARKEST: Final = 1e-12  # What replaces a white level of 0: an image that is black stays black


def develop(
    image: Image,
    light: npt.NDArray[np.float64],
    mask: npt.NDArray[np.bool_] | None = None,
    matrix: ColourMatrix | None = None,
    saturation: float | None = None,
) -> npt.NDArray[np.uint8]:
    """Return the sRGB picture of a raw image; the steps stand at the head of this file.

    `image`: (H, W, 3) uint16, float32 or float64, linear camera RGB ≥ 0, black subtracted, any unit. `light`: (3,)
    float64 > 0, linear camera RGB of any length: the ground truth. `mask`: (H, W) bool, True where a pixel has no say
    in the white level; None if all have. `matrix`: of the camera; None takes balanced camera RGB for linear sRGB.
    `saturation`: value of the image from which a channel is clipped; None if none is. Returns (H, W, 3) uint8, sRGB
    codes.

    Examples
    --------
    A grey wedge stays grey, whatever the light and the camera; one in a hundred values is clipped:

    >>> from generator.rendering.matrices import camera_matrix
    >>> wedge = np.linspace(0, 1, 5)[:, None, None] * np.array([400.0, 1000.0, 700.0])
    >>> develop(wedge, np.array([0.4, 1.0, 0.7]), matrix=camera_matrix("EOS 550D"))[:, 0]
    array([[  0,   0,   0],
           [138, 138, 138],
           [188, 188, 188],
           [226, 226, 226],
           [255, 255, 255]], dtype=uint8)
    """
    if not (np.isfinite(light).all() and light.min() > 0):
        raise InputError(f"a picture cannot be balanced for the light {light.tolist()}; expected three numbers above 0")
    linear: npt.NDArray[np.float64] = np.asarray(image, dtype=np.float64) * (light[1] / light)
    if saturation is not None:
        linear = np.minimum(linear, saturation * float((light[1] / light).min()))
    if matrix is not None:
        linear = np.asarray(linear @ np.linalg.inv(matrix.rows).T, dtype=np.float64)
    seen = linear.reshape(-1, 3) if mask is None else linear[~mask]
    white = float(np.percentile(seen, WHITE_PERCENTILE, axis=0).max()) if len(seen) else 0.0
    return srgb_codes(linear / max(white, _DARKEST))


@dataclass(frozen=True, eq=False)
class DevelopedSource:
    """A real image as a source picture of the generator, developed with its ground truth.

    `matrix`: of its camera; None for none.
    """

    scene: Scene
    matrix: ColourMatrix | None = None

    @property
    def name(self) -> str:
        """The image's name."""
        return self.scene.name

    def to_json(self) -> dict[str, Any]:
        """Return how the picture is made, as a JSON object."""
        return {"developed": self.scene.name, "matrix": self.matrix and self.matrix.name}

    def read(self) -> SourcePicture:
        """Return the picture, codes (H, W, 3) uint8; masked pixels are black."""
        image, mask = self.scene.read()
        picture = develop(image, self.scene.truth, mask, self.matrix, self.scene.saturation)
        if mask is not None:
            picture[mask] = 0
        return SourcePicture(picture)


def developed(data: SceneSet, matrix: ColourMatrix | None) -> tuple[DevelopedSource, ...]:
    """Return the images of a data set as source pictures, developed with the colour matrix of its camera or none."""
    return tuple(DevelopedSource(scene, matrix) for scene in data.scenes)


_TEXTS = (".csv", ".txt")  # Endings of files of text


@dataclass(frozen=True, eq=False)
class Truths:
    """Ground truths with a name for tables and legends.

    - `name`: where they come from.
    - `lights`: (N, 3) float64 ≥ 0, linear camera RGB of any length.
    - `images`: the names of their N images; empty where they have none.
    """

    name: str
    lights: npt.NDArray[np.float64]
    images: tuple[str, ...] = ()


def read_truths(place: str) -> Truths:
    """Return the ground truths at a place."""
    file, _, start = place.partition("#")
    if not file.lower().endswith(_TEXTS):
        data = open_scenes(place)
        return Truths(
            data.name, np.stack([scene.truth for scene in data.scenes]), tuple(scene.name for scene in data.scenes)
        )
    lights = load_ground_truths(Path(file))
    names = _first_column(Path(file))
    if not start:
        return Truths(Path(file).stem, lights, tuple(names) if len(names) == len(lights) else ())
    if len(names) != len(lights):
        raise FormatError(f"{file} has {len(lights)} ground truths and {len(names)} names; {start!r} cannot choose")
    chosen = np.array([name.startswith(start) for name in names])
    if not chosen.any():
        raise InputError(f"no row of {file} begins with {start!r}; the first begins with {names[0]!r}")
    return Truths(start.strip("/_"), lights[chosen], tuple(name for name in names if name.startswith(start)))


def _first_column(path: Path) -> list[str]:
    rows = csv.reader(path.read_text(encoding="utf-8-sig").splitlines())
    return [row[0] for row in rows if row and any(field.strip() for field in row)][1:]
