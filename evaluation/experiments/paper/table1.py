"""The paper's tables: plain methods on eight generated data sets (4.3), learned ones on real images (4.4).

Two sets of scenes (pictures that are given, and pictures of random codes), two tables, two choices of lights (nearest
to the ground truths of a real data set, and drawn from all of the table) make eight data sets. The paper names neither
the size nor the number of its images, nor how many lights it drew. Ours: as many random scenes as pictures, squares of
`side` px; pictures scaled to a longest side of `side` px; one light for each image.

Two more tables explain the row: how noisy the print's white is, and how grey the print is. The paper's 550D tables give
White-Patch mean errors of 9 to 26°, which noise cannot: a hot photosite can be above every white of its channel. `sim
table --hot` makes tables with some.
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
    rendered,
)
from evaluation.experiments.paper.published import TABLE1, TABLE2, Cell
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


# The black body, kelvin, under which the print's colours are looked at: near what pictures are balanced for.
DAYLIGHT_K: Final = 5600.0


def noise_table(luts: Sequence[Lut]) -> Table:
    """Return how bright and noisy the white of tables' prints is, percent: what White-Patch lives on.

    Medians over the lights: of the white cell's brightest channel over saturation, of the standard deviation of its
    samples over their mean, and of the largest of them over their mean, less 1.
    """
    rows: list[tuple[str | float | None, ...]] = []
    for lut in luts:
        white = np.asarray(lut.samples[:, -1], dtype=np.float64)
        mean = np.maximum(white.mean(axis=1), 1.0)
        level = np.median(mean.max(axis=1)) / lut.provenance.white_level
        spread = np.median(white.std(axis=1, ddof=1) / mean, axis=0)
        largest = np.median(white.max(axis=1) / mean - 1, axis=0)
        rows.append((lut.provenance.camera, len(white), *(100 * float(part) for part in (level, *spread, *largest))))
    columns = ("Camera", "Lights", "White, % of saturation", "Spread of its samples R, %", "G, %", "B, %")
    return Table(
        "The print's white in the tables: medians over the lights",
        (*columns, "Largest sample above the mean R, %", "G, %", "B, %"),
        tuple(rows),
    )


def print_table(luts: Sequence[Lut]) -> Table:
    """Return the mean and root mean square of all colours of tables' prints: what Gray-world and its like see.

    Percent of the white of the black body nearest to `DAYLIGHT_K`, or of the table's first light; with the angle from
    grey.
    """
    rows: list[tuple[str | float | None, ...]] = []
    for lut in luts:
        away = [abs(light.cct_k - DAYLIGHT_K) if light.cct_k else np.inf for light in lut.illuminations]
        light = int(np.argmin(away))
        reflected = np.asarray(lut.samples[light], dtype=np.float64).reshape(-1, 3) / lut.white[light]
        means = {"mean": reflected.mean(axis=0), "root mean square": np.sqrt((reflected**2).mean(axis=0))}
        for name, values in means.items():
            angle = float(angles_deg(values, (1.0, 1.0, 1.0)))
            rows.append((lut.provenance.camera, light, name, *(100 * float(part) for part in values), angle))
    return Table(
        "All colours of the print together, % of the light's white",
        ("Camera", "Light", "Of all colours", "R, %", "G, %", "B, %", "From grey, degrees"),
        tuple(rows),
    )


_Thing = TypeVar("_Thing")

# The methods of the table, by their names on the command line.
METHODS: Final = ("white-patch", "gray-world", "shades-of-gray")

# Side of an image, px; White-Patch takes the largest of so many noisy values, and its error grows with them.
SIDE: Final = 512

# Most images of a data set on which sizes and hot photosites are studied: their medians differ by more than chance
# among 64, and every image of 1024 px is drawn for each of them.
STUDIED: Final = 64

# The paper's names of its cameras, by those that tables have.
SENSORS: Final[Mapping[str, str]] = {"Canon EOS 550D": "550D", "Canon EOS 6D Mark II": "6D"}

# Names of pictures and of ground truths of which nothing is said: the paper has no numbers of them.
OWN: Final = ("Given", "Given")

# What a row of numbers is about, in CSV.
_HEAD: Final = ("scenes", "sensor", "illuminations", "images", "method", "error")


@dataclass(frozen=True, eq=False)
class Block:
    """One of the eight data sets and what the methods made of it.

    - `cell`: scenes, sensor and illuminations, as the paper names them: ``("C1", "6D", "Random")``; the paper's numbers
      are found by it, so other scenes and lights have names of their own.
    - `lights`: how their lights were chosen, in words.
    - `results`: one a method, in the order of `METHODS`; empty before it is evaluated.
    """

    cell: Cell
    scenes: tuple[RenderedScene, ...]
    lights: str
    results: tuple[Result, ...] = ()


def sensor_of(lut: Lut) -> str:
    """Return the paper's name of a table's camera, or the camera's own."""
    return SENSORS.get(lut.provenance.camera, lut.provenance.camera)


def settings(
    luts: Sequence[Lut],
    pictures: Sequence[Source],
    truths: npt.NDArray[np.float64],
    side: int = SIDE,
    seed: int = 0,
    names: tuple[str, str] = OWN,
) -> tuple[Block, ...]:
    """Return the data sets of the table in the paper's order: scenes, then tables, then lights.

    `truths`: (N, 3) float64 ≥ 0, the ground truths that the first choice of lights is to be like; linear camera RGB of
    any length, taken as they are although another camera saw them, as in the paper. `side`: longest side of every
    image, px.
    """
    count = len(pictures)
    if not count:
        raise InputError("there is no picture to print; name some")
    sets: dict[str, Sequence[Source]] = {
        names[0]: [ScaledSource(picture, side) for picture in pictures],
        "Random": random_scenes(count, side, side, seed),
    }
    found: list[Block] = []
    for scenes, sources in sets.items():
        for lut in luts:
            choices: dict[str, ChosenLights] = {
                names[1]: lights_like(lut, truths, count),
                "Random": lights_at_random(lut, count, seed),
            }
            found += [
                Block((scenes, sensor_of(lut), lights), rendered(lut, sources, chosen, seed), chosen.how)
                for lights, chosen in choices.items()
            ]
    return tuple(found)


def thinned(things: Sequence[_Thing], most: int = STUDIED) -> Sequence[_Thing]:
    """Return at most `most` of the things, evenly spaced.

    Examples
    --------
    >>> [source.number for source in thinned(random_scenes(7, 4, 4), 3)]
    [0, 2, 4]
    """
    count = min(len(things), most)
    return [things[place * len(things) // count] for place in range(count)]


def table1(chosen: Sequence[Block], workers: int = 1, on_scene: Callable[[], None] | None = None) -> tuple[Block, ...]:
    """Return the data sets with what the methods make of each."""
    methods = [standard_methods()[name] for name in METHODS]
    return tuple(replace(part, results=evaluate(part.scenes, methods, workers, on_scene)) for part in chosen)


def block_title(cell: Cell) -> str:
    """Return the paper's head of a data set.

    Examples
    --------
    >>> block_title(("C1", "6D", "Random"))
    'C1 scenes, 6D sensor, random illuminations'
    """
    scenes, sensor, lights = (part.lower() if part == "Random" else part for part in cell)
    return f"{scenes[0].upper()}{scenes[1:]} scenes, {sensor} sensor, {lights} illuminations"


def block_table(block: Block, kind: ErrorKind) -> Table:
    """Return the table of one data set: each method's six numbers, and below them the paper's where it has some."""
    published = TABLE1.get(block.cell, {})
    rows: list[tuple[str | float | None, ...]] = []
    for result in block.results:
        rows.append((result.marked_name, *result.summary(kind).as_tuple()))
        if result.method in published:
            rows.append(("paper", *published[result.method].as_tuple()))
    notes = [f"{counted(len(block.scenes), 'image')}; lights {block.lights}."]
    notes += [
        f"{result.method}: no usable pixel in {counted(int(result.guessed.sum()), 'image')}, whose light "
        "was taken to be grey."
        for result in block.results
        if result.guessed.any()
    ]
    return Table(block_title(block.cell), PAPER_COLUMNS, tuple(rows), notes=tuple(notes))


def joint_table(blocks: Sequence[Block]) -> Table:
    """Return all data sets, both kinds of error and the paper's numbers as one table, for CSV."""
    kinds: tuple[ErrorKind, ...] = ("reproduction", "recovery")
    rows: list[tuple[str | float | None, ...]] = []
    for block in blocks:
        published = TABLE1.get(block.cell, {})
        for result in block.results:
            head = (*block.cell, len(block.scenes), result.method)
            given = {str(kind): result.summary(kind).as_tuple() for kind in kinds}
            if result.method in published:
                given["paper"] = published[result.method].as_tuple()
            rows += [(*head, name, *numbers) for name, numbers in given.items()]
    return Table(
        "Errors on generated data sets, degrees",
        (*_HEAD, *STATISTICS_COLUMNS[:6]),
        tuple(rows),
    )


@dataclass(frozen=True)
class SizeRow:
    """Median errors of the methods on one data set whose images have one side.

    - `side`: longest side of the images, px.
    - `medians`: median reproduction errors, degrees, by method.
    """

    cell: Cell
    side: int
    medians: Mapping[str, float]


def size_dependence(
    luts: Sequence[Lut],
    pictures: Sequence[Source],
    truths: npt.NDArray[np.float64],
    sides: Sequence[int],
    seed: int = 0,
    workers: int = 1,
    names: tuple[str, str] = OWN,
) -> tuple[SizeRow, ...]:
    """Return the methods' median reproduction errors for images of several sizes, of `STUDIED` pictures at most.

    `truths`: (N, 3) float64, as of `settings`. `sides`: longest sides of the images, px.
    """
    rows: list[SizeRow] = []
    for side in sides:
        for block in table1(settings(luts, thinned(pictures), truths, side, seed, names), workers):
            medians = {result.method: result.summary("reproduction").median for result in block.results}
            rows.append(SizeRow(block.cell, side, medians))
    return tuple(rows)


def size_table(rows: Sequence[SizeRow]) -> Table:
    """Return the medians of `size_dependence` as a table."""
    names = list(dict.fromkeys(name for row in rows for name in row.medians))
    return Table(
        "Median reproduction error for images of several sizes, degrees",
        ("Data set", "Side, px", *names),
        tuple((block_title(row.cell), row.side, *(row.medians[name] for name in names)) for row in rows),
    )


# The learners of the table: our short names, and the paper's names.
LEARNERS: Final[Mapping[str, str]] = {
    "regression-trees": "Regression trees (simple features)",
    "smart-color-cat": "Smart Color Cat",
    "color-beaver": "Color Beaver (using Gray-world)",
}


@dataclass(frozen=True, eq=False)
class Trained:
    """What one learner reaches, trained on real and on generated images.

    `real`, `generated`: its results on the real images.
    """

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
) -> tuple[Trained, ...]:
    """Return the results of each learner, trained on real and on generated images.

    `folds`: (N,) int64, the fold of each real image.
    """
    if not generated or not learners:
        raise InputError(f"{len(learners)} learners and {len(generated)} generated images: name at least one of each")
    chosen = list(learners.values())
    crossed = cross_validate(real, chosen, folds, seed, workers, on_scene)
    fitted = [fit_copy(learner, generated, seed) for learner in chosen]
    moved = evaluate(real, fitted, workers, on_scene)
    return tuple(Trained(name, *both) for name, *both in zip(learners, crossed, moved, strict=True))


def table2_tables(found: Sequence[Trained], kind: ErrorKind, name: str, with_published: bool = True) -> list[Table]:
    """Return the two halves of the paper's table, and the ratios of their medians."""
    heads: Mapping[str, str] = {
        "real": f"Trained and tested on {name} (through cross-validation)",
        "generated": f"Trained on the generated data set and tested on {name}",
    }
    tables: list[Table] = []
    for training, title in heads.items():
        rows: list[tuple[str | float | None, ...]] = []
        published = TABLE2["real" if training == "real" else "generated"]
        for trained in found:
            result = trained.real if training == "real" else trained.generated
            rows.append((result.marked_name, *result.summary(kind).as_tuple()))
            known = published.get(LEARNERS.get(trained.learner, ""))
            if known and with_published:
                rows.append(("paper", *known.as_tuple()))
        tables.append(Table(title, PAPER_COLUMNS, tuple(rows)))
    return [*tables, _ratios(found, kind, name)]


def _ratios(found: Sequence[Trained], kind: ErrorKind, name: str) -> Table:
    rows: list[tuple[str | float | None, ...]] = []
    for trained in found:
        ours = trained.generated.summary(kind).median / trained.real.summary(kind).median
        paper = LEARNERS.get(trained.learner)
        theirs = TABLE2["generated"][paper].median / TABLE2["real"][paper].median if paper else None
        rows.append((trained.real.method, ours, theirs))
    return Table(
        f"Median trained on generated images over median trained on real ones, tested on {name}",
        ("Algorithm", "Ratio", "In the paper, on Cube+"),
        tuple(rows),
    )
