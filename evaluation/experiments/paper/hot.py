"""What a few hot photosites in a table do to White-Patch.

The paper's 550D tables give White-Patch mean errors of 9 to 26°, which noise cannot: the largest of thousands of normal
deviates lies a few standard deviations above the mean, some percent of a white. A photosite whose dark signal is high
can be above every white of its channel, and the largest value of an image is then its. The simulated sensors have shot
and read noise and, unless a room asks for them, no such photosites, and `build-lut` is told nothing of any; here some
are put into a table that is read, and nothing is written.

A hot photosite is one of a table's values (colour, sample, channel), the same under every light as on a sensor that
stands still. Its dark signal, drawn evenly from 0 to saturation, is added, and the sum cut below saturation, since
methods leave out what is clipped. All of that is a model: nobody has measured the paper's camera for it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from evaluation.experiments.paper.scenes.rendering import RenderedScene
from evaluation.experiments.paper.table1 import NUMBERS, Setting, block_title, thinned
from evaluation.experiments.running import evaluate
from evaluation.methods.standard import standard_methods
from evaluation.metrics import ErrorKind
from evaluation.results.tables import Table
from foundation.errors import InputError
from generator.kernels.choice import replace_unfit_colours
from generator.kernels.rendering import draw_samples

if TYPE_CHECKING:
    from evaluation.results.result import Result
    from generator import Lut


@dataclass(frozen=True, eq=False)
class HotPhotosites:
    """Values of a table that are raised.

    - `places`: (M,) int64, places in a light's samples, flattened from (colours, samples, 3).
    - `signals`: (M,) float64, dark signal of each, in units of the samples.
    """

    places: npt.NDArray[np.int64]
    signals: npt.NDArray[np.float64]

    def raise_in(self, samples: npt.NDArray[np.uint16], saturation: float) -> npt.NDArray[np.uint16]:
        """Return a light's samples (colours, samples, 3) uint16 with the dark signals added, cut below saturation."""
        raised = np.array(samples)
        flat = raised.reshape(-1)
        values = np.minimum(flat[self.places] + self.signals, np.ceil(saturation) - 1)
        flat[self.places] = np.maximum(values, flat[self.places]).astype(np.uint16)
        return raised


def hot_photosites(lut: Lut, per_million: float, seed: int = 0) -> HotPhotosites:
    """Return hot photosites of a table: so many in a million of a light's values, rounded to a whole number."""
    values = int(np.prod(lut.samples.shape[1:]))
    if not 0 <= per_million <= 1e6:
        raise InputError(f"{per_million:g} hot photosites in a million were asked for, expected 0 to a million")
    rng = np.random.default_rng(seed)
    places = rng.permutation(values)[: round(values * per_million / 1e6)].astype(np.int64)
    return HotPhotosites(places, rng.uniform(0, lut.provenance.white_level, len(places)))


@dataclass(frozen=True, eq=False)
class HotScene:
    """A scene as a sensor with hot photosites would give it."""

    scene: RenderedScene
    hot: HotPhotosites

    @property
    def name(self) -> str:
        """The image's number."""
        return self.scene.name

    @property
    def truth(self) -> npt.NDArray[np.float64]:
        """The light (3,) float64, linear camera RGB, r + g + b = 1."""
        return self.scene.truth

    @property
    def saturation(self) -> float:
        """White level of the table."""
        return self.scene.saturation

    def read(self) -> tuple[npt.NDArray[np.uint16], None]:
        """Return the image (H, W, 3) uint16, linear camera RGB, and no mask."""
        scene = self.scene
        samples = self.hot.raise_in(scene.lut.samples[scene.light], scene.saturation)
        picture, _ = replace_unfit_colours(scene.source.read().picture, scene.lut.provenance)
        return draw_samples(samples, picture, seed=scene.seed, image=scene.number), None


@dataclass(frozen=True, eq=False)
class HotRow:
    """White-Patch on one data set with one share of hot photosites.

    - `title`: the data set's.
    - `per_million`: hot photosites in a million.
    - `count`: how many that are in the table.
    - `result`: white-Patch's.
    """

    title: str
    per_million: float
    count: int
    result: Result


def hot_rows(chosen: Sequence[Setting], shares: Sequence[float], seed: int = 0, workers: int = 1) -> tuple[HotRow, ...]:
    """Return White-Patch's results on data sets whose tables have hot photosites.

    `shares`: hot photosites in a million of a light's values.
    """
    method = standard_methods()["white-patch"]
    rows: list[HotRow] = []
    for part in chosen:
        scenes = thinned(part.scenes)
        for share in shares:
            hot = hot_photosites(part.scenes[0].lut, share, seed)
            (result,) = evaluate([HotScene(scene, hot) for scene in scenes], [method], workers)
            rows.append(HotRow(block_title(part.cell), share, len(hot.places), result))
    return tuple(rows)


def hot_table(rows: Sequence[HotRow], kind: ErrorKind) -> Table:
    """Return the six numbers of White-Patch for each data set and share of hot photosites."""
    return Table(
        f"White-Patch where a table has hot photosites, {kind} error in degrees",
        ("Data set", "Per million", "In the table", *NUMBERS),
        tuple((row.title, row.per_million, row.count, *row.result.summary(kind).as_tuple()) for row in rows),
        notes=(
            "A model: dark signals drawn evenly up to saturation, at the same places under every light. The simulated "
            "sensors have none unless their room asks for some.",
        ),
    )
