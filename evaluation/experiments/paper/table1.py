"""Tables of the paper: statistics-based methods on generated data sets (section 4.3), learned methods (section 4.4).

Eight data sets are all combinations of two sets of scenes, two look-up tables (LUT) and two choices of illuminants.
Scenes are given pictures or random codes. Illuminants are nearest to the ground truths of a real data set, or drawn
from the LUT. The paper does not report sizes and numbers of images and illuminants. Here, there are as many random
scenes as pictures, each image has a longest side of `side` px, and it is under one illuminant.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final, TypeVar

import numpy as np
import numpy.typing as npt

from evaluation.experiments.cross_validation import cross_validate
from evaluation.experiments.paper.material import (
    ChosenLights,
    RenderedScene,
    ScaledSource,
    lights_at_random,
    lights_like,
    render_scenes,
)
from evaluation.experiments.paper.published import TABLE1, TABLE2, BlockKey
from evaluation.experiments.running import evaluate, fit_copy
from evaluation.methods.method import Learner
from evaluation.methods.standard import standard_methods
from evaluation.metrics import ErrorKind
from evaluation.results.result import Result
from evaluation.results.tables import PAPER_COLUMNS, STATISTICS_COLUMNS, Table
from evaluation.scene import Scene
from foundation.colorimetry import angles_deg
from foundation.errors import InputError, counted
from generator.pictures.random_scenes import random_scenes
from generator.pictures.sources import Source

if TYPE_CHECKING:
    from generator import Lut


# Colour temperature of the illuminant in `printed_colours_table`, K: close to the white balance of usual pictures.
DAYLIGHT_K: Final = 5600.0


def noise_table(luts: Sequence[Lut]) -> Table:
    """Return level and noise of the white patch in LUTs, percent. They determine the errors of White-Patch.

    Values are medians over the illuminants. Level: mean of the brightest channel, relative to the saturation level.
    Spread: standard deviation of the samples, relative to their mean. Largest sample: its excess over the mean,
    relative to the mean.
    """
    # The paper's White-Patch errors with the 550D (means of 9 to 26°) are too large to be caused by noise. A hot
    # photosite could cause them, because its value can be larger than those of white. `sim table --hot` simulates hot
    # photosites.
    rows: list[tuple[str | float | None, ...]] = []
    for lut in luts:
        white = np.asarray(lut.samples[:, -1], dtype=np.float64)
        mean = np.maximum(white.mean(axis=1), 1.0)
        level = np.median(mean.max(axis=1)) / lut.provenance.white_level
        spread = np.median(white.std(axis=1, ddof=1) / mean, axis=0)
        largest = np.median(white.max(axis=1) / mean - 1, axis=0)
        rows.append((lut.provenance.camera, len(white), *(100 * float(value) for value in (level, *spread, *largest))))
    columns = ("Camera", "Lights", "White, % of saturation", "Spread of its samples R, %", "G, %", "B, %")
    return Table(
        "White of the print in the look-up tables: medians over the illuminants",
        (*columns, "Largest sample above the mean R, %", "G, %", "B, %"),
        tuple(rows),
    )


def printed_colours_table(luts: Sequence[Lut]) -> Table:
    """Return mean and root mean square of all colours of prints, for the errors of Gray-world and Shades-of-Gray.

    Values are percent of white, and an angle from grey. The illuminant is the one with the colour temperature nearest
    to `DAYLIGHT_K`; without colour temperatures, it is the first illuminant.
    """
    rows: list[tuple[str | float | None, ...]] = []
    for lut in luts:
        distances_k = [abs(light.cct_k - DAYLIGHT_K) if light.cct_k else np.inf for light in lut.illuminations]
        light = int(np.argmin(distances_k))
        reflected = np.asarray(lut.samples[light], dtype=np.float64).reshape(-1, 3) / lut.white[light]
        means = {"mean": reflected.mean(axis=0), "root mean square": np.sqrt((reflected**2).mean(axis=0))}
        for name, values in means.items():
            angle = float(angles_deg(values, (1.0, 1.0, 1.0)))
            rows.append((lut.provenance.camera, light, name, *(100 * float(value) for value in values), angle))
    return Table(
        "All colours of the print together, % of the white",
        ("Camera", "Light", "Of all colours", "R, %", "G, %", "B, %", "From grey, degrees"),
        tuple(rows),
    )


_Item = TypeVar("_Item")

# Methods of table 1, by their names on the command line.
METHODS: Final = ("white-patch", "gray-world", "shades-of-gray")

# Default longest side of an image, px. White-Patch uses the largest of noisy values, so its error grows with the side.
SIDE: Final = 512

# Largest number of images in the study of image sizes. It suffices to show how medians depend on size. All images are
# rendered again for each size, which takes long.
MAX_STUDIED: Final = 64

# Names of cameras in the paper, by their names in LUTs.
SENSORS: Final[Mapping[str, str]] = {"Canon EOS 550D": "550D", "Canon EOS 6D Mark II": "6D"}

# Names of pictures and of ground truths if the paper has no numbers for them.
UNPUBLISHED: Final = ("Given", "Given")

# Columns of a CSV row before the statistics.
_BLOCK_COLUMNS: Final = ("scenes", "sensor", "illuminations", "images", "method", "error")


@dataclass(frozen=True, eq=False)
class Block:
    """One of the eight data sets, a block of table 1, with the results of the methods."""

    # Scenes, sensor and illuminants as in the paper: ``("C1", "6D", "Random")``. This is the key of published numbers,
    # so other scenes and illuminants must have other names.
    key: BlockKey
    scenes: tuple[RenderedScene, ...]
    lights: str  # Text that describes the choice of illuminants
    results: tuple[Result, ...] = ()  # One for each method, in the order of `METHODS`; empty before evaluation


def sensor_of(lut: Lut) -> str:
    """Return the name of the LUT's camera in the paper, or its name in the LUT if the paper has none."""
    return SENSORS.get(lut.provenance.camera, lut.provenance.camera)


def plan_blocks(
    luts: Sequence[Lut],
    pictures: Sequence[Source],
    truths: npt.NDArray[np.float64],
    side: int = SIDE,
    seed: int = 0,
    names: tuple[str, str] = UNPUBLISHED,
) -> tuple[Block, ...]:
    """Return the data sets of table 1 in the order of the paper: scenes, then LUTs, then illuminants.

    `truths`: (N, 3) float64 ≥ 0, ground truths to which the nearest illuminants are chosen, linear camera RGB of any
    length. As in the paper, they are not converted, although another camera measured them. `side`: longest side of
    every image, px. `names`: names of the pictures and of the ground truths.
    """
    count = len(pictures)
    if not count:
        raise InputError("there are 0 pictures, expected at least 1; give some")
    sets: dict[str, Sequence[Source]] = {
        names[0]: [ScaledSource(picture, side) for picture in pictures],
        "Random": random_scenes(count, side, side, seed),
    }
    blocks: list[Block] = []
    for scenes, sources in sets.items():
        for lut in luts:
            choices: dict[str, ChosenLights] = {
                names[1]: lights_like(lut, truths, count),
                "Random": lights_at_random(lut, count, seed),
            }
            blocks += [
                Block((scenes, sensor_of(lut), lights), render_scenes(lut, sources, choice, seed), choice.how)
                for lights, choice in choices.items()
            ]
    return tuple(blocks)


def evenly_spaced(items: Sequence[_Item], max_count: int = MAX_STUDIED) -> Sequence[_Item]:
    """Return at most `max_count` of the items, evenly spaced.

    Examples
    --------
    >>> [source.number for source in evenly_spaced(random_scenes(7, 4, 4), 3)]
    [0, 2, 4]
    """
    count = min(len(items), max_count)
    return [items[index * len(items) // count] for index in range(count)]


def table1(blocks: Sequence[Block], workers: int = 1, on_scene: Callable[[], None] | None = None) -> tuple[Block, ...]:
    """Run the methods on the data sets, and return the data sets with the results."""
    methods = [standard_methods()[name] for name in METHODS]
    return tuple(replace(block, results=evaluate(block.scenes, methods, workers, on_scene)) for block in blocks)


def block_title(key: BlockKey) -> str:
    """Return the title of a data set as in the paper.

    Examples
    --------
    >>> block_title(("C1", "6D", "Random"))
    'C1 scenes, 6D sensor, random illuminations'
    """
    scenes, sensor, lights = (name.lower() if name == "Random" else name for name in key)
    return f"{scenes[0].upper()}{scenes[1:]} scenes, {sensor} sensor, {lights} illuminations"


def block_table(block: Block, metric: ErrorKind) -> Table:
    """Return the table of one data set: statistics of each method, each followed by published statistics if known."""
    published = TABLE1.get(block.key, {})
    rows: list[tuple[str | float | None, ...]] = []
    for result in block.results:
        rows.append((result.marked_name, *result.summary(metric).as_tuple()[:6]))
        if result.method in published:
            rows.append(("paper", *published[result.method].as_tuple()))
    notes = [f"{counted(len(block.scenes), 'image')}; illuminants {block.lights}."]
    notes += [
        f"{result.method}: no usable pixel in {counted(int(result.guessed.sum()), 'image')}; grey was used as "
        "their estimate."
        for result in block.results
        if result.guessed.any()
    ]
    return Table(block_title(block.key), PAPER_COLUMNS, tuple(rows), notes=tuple(notes))


def joint_table(blocks: Sequence[Block]) -> Table:
    """Return all data sets, both kinds of error and the published numbers as one table, for CSV."""
    kinds: tuple[ErrorKind, ...] = ("reproduction", "recovery")
    rows: list[tuple[str | float | None, ...]] = []
    for block in blocks:
        published = TABLE1.get(block.key, {})
        for result in block.results:
            row_start = (*block.key, len(block.scenes), result.method)
            statistics = {str(metric): result.summary(metric).as_tuple()[:6] for metric in kinds}
            if result.method in published:
                statistics["paper"] = published[result.method].as_tuple()
            rows += [(*row_start, name, *numbers) for name, numbers in statistics.items()]
    return Table("Errors on generated data sets, degrees", (*_BLOCK_COLUMNS, *STATISTICS_COLUMNS[:6]), tuple(rows))


@dataclass(frozen=True)
class SizeRow:
    """Median errors of the methods on one data set with images of one size."""

    key: BlockKey
    side: int  # Longest side of the images, px
    medians: Mapping[str, float]  # Median reproduction error by method, degrees


def size_dependence(
    luts: Sequence[Lut],
    pictures: Sequence[Source],
    truths: npt.NDArray[np.float64],
    sides: Sequence[int],
    seed: int = 0,
    workers: int = 1,
    names: tuple[str, str] = UNPUBLISHED,
) -> tuple[SizeRow, ...]:
    """Return median reproduction errors for several image sizes; at most `MAX_STUDIED` pictures are used.

    `truths`: as in `plan_blocks`. `sides`: longest sides of the images, px.
    """
    rows: list[SizeRow] = []
    for side in sides:
        for block in table1(plan_blocks(luts, evenly_spaced(pictures), truths, side, seed, names), workers):
            medians = {result.method: result.summary("reproduction").median for result in block.results}
            rows.append(SizeRow(block.key, side, medians))
    return tuple(rows)


def size_table(rows: Sequence[SizeRow]) -> Table:
    """Return the table of median errors by image size."""
    names = list(dict.fromkeys(name for row in rows for name in row.medians))
    return Table(
        "Median reproduction error for images of several sizes, degrees",
        ("Data set", "Side, px", *names),
        tuple((block_title(row.key), row.side, *(row.medians[name] for name in names)) for row in rows),
    )


# Names of the learners of table 2 in the paper, by their names in this suite.
LEARNERS: Final[Mapping[str, str]] = {
    "regression-trees": "Regression trees (simple features)",
    "smart-color-cat": "Smart Color Cat",
    "color-beaver": "Color Beaver (using Gray-world)",
}


@dataclass(frozen=True, eq=False)
class TrainingComparison:
    """Results of one learner on real images: cross-validated (`real`), or trained on generated images (`generated`)."""

    learner: str
    real: Result
    generated: Result


def table2(
    real: Sequence[Scene],
    generated: Sequence[Scene],
    learners: Mapping[str, Learner],
    folds: npt.NDArray[np.int64],
    seed: int = 0,
    workers: int = 1,
    on_scene: Callable[[], None] | None = None,
) -> tuple[TrainingComparison, ...]:
    """Return the results of each learner, trained on real and on generated images; `folds`: (N,) int64."""
    if not generated or not learners:
        raise InputError(
            f"{len(learners)} learners and {len(generated)} generated images, expected at least one each; give some"
        )
    learner_list = list(learners.values())
    cross_validated = cross_validate(real, learner_list, folds, seed, workers, on_scene)
    fitted = [fit_copy(learner, generated, seed) for learner in learner_list]
    transferred = evaluate(real, fitted, workers, on_scene)
    pairs = zip(learners, cross_validated, transferred, strict=True)
    return tuple(TrainingComparison(*pair) for pair in pairs)


def table2_tables(
    comparisons: Sequence[TrainingComparison], metric: ErrorKind, name: str, with_published: bool = True
) -> list[Table]:
    """Return the two halves of table 2 (training on real and on generated images), and the ratios of their medians."""
    titles: Mapping[str, str] = {
        "real": f"Trained and tested on {name} (through cross-validation)",
        "generated": f"Trained on the generated data set and tested on {name}",
    }
    tables: list[Table] = []
    for training, title in titles.items():
        rows: list[tuple[str | float | None, ...]] = []
        published = TABLE2["real" if training == "real" else "generated"]
        for trained in comparisons:
            result = trained.real if training == "real" else trained.generated
            rows.append((result.marked_name, *result.summary(metric).as_tuple()[:6]))
            published_row = published.get(LEARNERS.get(trained.learner, ""))
            if published_row and with_published:
                rows.append(("paper", *published_row.as_tuple()))
        tables.append(Table(title, PAPER_COLUMNS, tuple(rows)))
    return [*tables, _ratio_table(comparisons, metric, name)]


def _ratio_table(comparisons: Sequence[TrainingComparison], metric: ErrorKind, name: str) -> Table:
    rows: list[tuple[str | float | None, ...]] = []
    for trained in comparisons:
        ratio = trained.generated.summary(metric).median / trained.real.summary(metric).median
        paper_name = LEARNERS.get(trained.learner)
        published = TABLE2["generated"][paper_name].median / TABLE2["real"][paper_name].median if paper_name else None
        rows.append((trained.real.method, ratio, published))
    return Table(
        f"Median trained on generated images over median trained on real ones, tested on {name}",
        ("Algorithm", "Ratio", "In the paper, on Cube+"),
        tuple(rows),
    )
