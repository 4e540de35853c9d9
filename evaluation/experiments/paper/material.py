"""Material of the paper's experiments: pictures, ground truths, illuminants and scenes generated in memory.

Image i of a set shows picture i under the i-th chosen illuminant. Samples are drawn as in `generate` with the same
seed, so `generate` can write the same images to files.

The pictures of the paper are "the sRGB images of the Canon 1Ds Mark III" (section 4.3). It does not describe how they
were developed. Here, they are developed from linear raw images with known ground truth (`develop_image`).
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
    """A picture rendered under one illuminant of a look-up table (LUT)."""

    lut: Lut
    source: Source
    light: int  # Index of the illuminant in the LUT
    number: int  # Index of the image in its set
    seed: int = 0  # 0 … 2⁶⁴ − 1; selects the samples

    @property
    def name(self) -> str:
        """Index of the image, as in file names of `generate`."""
        return f"{self.number:06d}"

    @property
    def truth(self) -> npt.NDArray[np.float64]:
        """Ground truth (3,) float64, linear camera RGB, r + g + b = 1."""
        return self.lut.ground_truth[self.light]

    @property
    def saturation(self) -> float:
        """Saturation level of the LUT, in the unit of the image."""
        return float(self.lut.provenance.white_level)

    def read(self) -> tuple[npt.NDArray[np.uint16], None]:
        """Return the image (H, W, 3) uint16, linear camera RGB, and no mask."""
        # The paper renders by codes.
        picture = self.source.read().picture
        image = render(self.lut, picture, self.light, rendering="codes", seed=self.seed, image=self.number)
        return image, None


@dataclass(frozen=True, eq=False)
class ScaledSource:
    """A picture, enlarged or reduced to a longest side of `side` px."""

    source: Source
    side: int

    @property
    def name(self) -> str:
        """Name of the picture."""
        return self.source.name

    def to_json(self) -> dict[str, Any]:
        """Return a JSON object that describes the picture."""
        return {**self.source.to_json(), "side": self.side}

    def read(self) -> SourcePicture:
        """Return the picture, codes (H, W, 3) uint8. It is reduced by area averages or enlarged by interpolation."""
        import cv2

        picture = self.source.read().picture
        height, width = picture.shape[:2]
        scale = self.side / max(height, width)
        size = (max(1, round(width * scale)), max(1, round(height * scale)))
        interpolation = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
        return SourcePicture(np.asarray(cv2.resize(picture, size, interpolation=interpolation), dtype=np.uint8))


@dataclass(frozen=True)
class ChosenLights:
    """One illuminant of a LUT for each image."""

    numbers: tuple[int, ...]  # Index of the illuminant of each image
    how: str  # Text that describes the choice


def lights_like(lut: Lut, truths: npt.NDArray[np.float64], count: int) -> ChosenLights:
    """Return for each image the illuminant of the LUT with the smallest angle to its ground truth.

    `truths`: (N, 3) float64 ≥ 0, linear camera RGB of any scale and any camera. Image i has ground truth i modulo N.
    """
    matches = nearest_lights(lut, truths).matches
    numbers = tuple(matches[image % len(matches)].mixture.lights[0] for image in range(count))
    used = matches[:count]
    angles = np.array([match.angle for match in used])
    truths_text = f"the first {len(used)} of {len(truths)}" if len(used) < len(truths) else f"{len(truths)}"
    return ChosenLights(
        numbers,
        f"nearest by angle to {truths_text} ground truths, {len(set(numbers))} different illuminants; median angle "
        f"{np.median(angles):.2f}°, largest {angles.max():.2f}°",
    )


def lights_at_random(lut: Lut, count: int, seed: int) -> ChosenLights:
    """Return for each image an illuminant drawn from all of the LUT, as `generate --random 1` does."""
    choice = RandomLights(1, len(lut.white), seed)
    numbers = tuple(choice.lightings_of(image)[0].mixtures[0].lights[0] for image in range(count))
    return ChosenLights(
        numbers, f"drawn from all {len(lut.white)} illuminants with seed {seed}, {len(set(numbers))} different"
    )


def render_scenes(lut: Lut, sources: Sequence[Source], lights: ChosenLights, seed: int) -> tuple[RenderedScene, ...]:
    """Return the scenes of the pictures under the chosen illuminants."""
    if len(sources) != len(lights.numbers):
        raise InputError(f"{len(lights.numbers)} illuminants, expected {len(sources)}; choose one for each picture")
    pairs = zip(sources, lights.numbers, strict=True)
    return tuple(RenderedScene(lut, source, light, number, seed) for number, (source, light) in enumerate(pairs))


WHITE_PERCENTILE: Final = 99.0  # Percentile of values that becomes white, as in dcraw ("99th-percentile white point")

_MIN_WHITE: Final = 1e-12  # Replaces a white of 0, so that a black image stays black


def develop_image(
    image: Image,
    light: npt.NDArray[np.float64],
    mask: npt.NDArray[np.bool_] | None = None,
    matrix: ColourMatrix | None = None,
    saturation: float | None = None,
) -> npt.NDArray[np.uint8]:
    """Return the sRGB picture (H, W, 3) uint8 of a raw image.

    `image`: (H, W, 3) uint16, float32 or float64, linear camera RGB ≥ 0, black level subtracted, any unit. `light`:
    (3,) float64 > 0, ground truth, linear camera RGB of any scale. `mask`: (H, W) bool, True for pixels that do not
    influence the white; None for no mask. `matrix`: colour matrix of the camera; None uses balanced camera RGB as
    linear sRGB. `saturation`: value from which a channel is clipped; None for no clipping.

    Examples
    --------
    A grey wedge stays grey for every illuminant and camera:

    >>> from generator.rendering.matrices import camera_matrix
    >>> wedge = np.linspace(0, 1, 5)[:, None, None] * np.array([400.0, 1000.0, 700.0])
    >>> develop_image(wedge, np.array([0.4, 1.0, 0.7]), matrix=camera_matrix("EOS 550D"))[:, 0]
    array([[  0,   0,   0],
           [138, 138, 138],
           [188, 188, 188],
           [226, 226, 226],
           [255, 255, 255]], dtype=uint8)
    """
    if not (np.isfinite(light).all() and light.min() > 0):
        raise InputError(f"the illuminant is {light.tolist()}, expected three numbers above 0; correct it")
    # Channels are balanced with green unchanged. Then all channels are clipped at the lowest balanced saturation, so
    # that clipped skies become white (dcraw -H 0). Without a saturation level, clipped skies are pink.
    linear: npt.NDArray[np.float64] = np.asarray(image, dtype=np.float64) * (light[1] / light)
    if saturation is not None:
        linear = np.minimum(linear, saturation * float((light[1] / light).min()))
    if matrix is not None:
        # The matrix does not change white.
        linear = np.asarray(linear @ np.linalg.inv(matrix.rows).T, dtype=np.float64)
    usable = linear.reshape(-1, 3) if mask is None else linear[~mask]
    white = float(np.percentile(usable, WHITE_PERCENTILE, axis=0).max()) if len(usable) else 0.0
    return srgb_codes(linear / max(white, _MIN_WHITE))


@dataclass(frozen=True, eq=False)
class DevelopedSource:
    """A real image that is developed with its ground truth and used as source picture of the generator.

    `matrix`: colour matrix of the camera, or None.
    """

    scene: Scene
    matrix: ColourMatrix | None = None

    @property
    def name(self) -> str:
        """Name of the image."""
        return self.scene.name

    def to_json(self) -> dict[str, Any]:
        """Return a JSON object that describes the picture."""
        return {"developed": self.scene.name, "matrix": self.matrix and self.matrix.name}

    def read(self) -> SourcePicture:
        """Return the picture, codes (H, W, 3) uint8; masked pixels are black."""
        image, mask = self.scene.read()
        picture = develop_image(image, self.scene.truth, mask, self.matrix, self.scene.saturation)
        if mask is not None:
            picture[mask] = 0
        return SourcePicture(picture)


def develop_sources(data: SceneSet, matrix: ColourMatrix | None) -> tuple[DevelopedSource, ...]:
    """Return the images of a data set as source pictures, developed with the camera's colour matrix or without one."""
    return tuple(DevelopedSource(scene, matrix) for scene in data.scenes)


_TEXT_EXTENSIONS = (".csv", ".txt")  # File extensions of text files with ground truths


@dataclass(frozen=True, eq=False)
class Truths:
    """Ground truths with a name for tables and legends."""

    name: str  # Name of the data set or file
    lights: npt.NDArray[np.float64]  # (N, 3) float64 ≥ 0, linear camera RGB of any scale
    images: tuple[str, ...] = ()  # Names of the N images; empty if unknown


def read_truths(location: str) -> Truths:
    """Return the ground truths of a data set, or of a text file: FILE, or FILE#PREFIX for images named PREFIX…."""
    file, _, prefix = location.partition("#")
    if not file.lower().endswith(_TEXT_EXTENSIONS):
        data = open_scenes(location)
        return Truths(
            data.name, np.stack([scene.truth for scene in data.scenes]), tuple(scene.name for scene in data.scenes)
        )
    lights = load_ground_truths(Path(file))
    names = _first_column(Path(file))
    if not prefix:
        return Truths(Path(file).stem, lights, tuple(names) if len(names) == len(lights) else ())
    if len(names) != len(lights):
        raise FormatError(
            f"{file} has {len(lights)} ground truths and {len(names)} image names, expected equal numbers; correct it"
        )
    is_chosen = np.array([name.startswith(prefix) for name in names])
    if not is_chosen.any():
        raise InputError(f"no row of {file} starts with {prefix!r}, expected a prefix such as {names[0]!r}; correct it")
    return Truths(prefix.strip("/_"), lights[is_chosen], tuple(name for name in names if name.startswith(prefix)))


def _first_column(path: Path) -> list[str]:
    rows = csv.reader(path.read_text(encoding="utf-8-sig").splitlines())
    return [row[0] for row in rows if row and any(field.strip() for field in row)][1:]
