"""The paper's first table: plain methods on eight generated data sets (section 4.3).

Two sets of scenes (pictures that are given, and pictures of random codes), two tables, two choices of lights (nearest
to the ground truths of a real data set, and drawn from all of the table) make eight data sets. The paper names neither
the size nor the number of its images, nor how many lights it drew. Ours: as many random scenes as pictures, squares of
`side` px; pictures scaled to a longest side of `side` px; one light for each image.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, TypeVar

import numpy as np
import numpy.typing as npt

from evaluation.experiments.paper.published import TABLE1, Cell
from evaluation.experiments.paper.scenes.rendering import (
    ChosenLights,
    RenderedScene,
    ScaledSource,
    lights_at_random,
    lights_like,
    rendered,
)
from evaluation.experiments.running import evaluate
from evaluation.methods.standard import standard_methods
from evaluation.metrics import ErrorKind
from evaluation.results.tables import Table
from foundation.errors import InputError, counted
from generator.pictures.sources import Source, random_scenes

if TYPE_CHECKING:
    from evaluation.results.result import Result
    from generator import Lut

_Thing = TypeVar("_Thing")

METHODS: Final = ("white-patch", "gray-world", "shades-of-gray")
"""The methods of the table, by their names on the command line."""

SIDE: Final = 512
"""Side of an image, px; White-Patch takes the largest of so many noisy values, and its error grows with them."""

STUDIED: Final = 64
"""Most images of a data set on which sizes and hot photosites are studied: their medians differ by more than chance
among 64, and every image of 1024 px is drawn for each of them."""

SENSORS: Final[Mapping[str, str]] = {"Canon EOS 550D": "550D", "Canon EOS 6D Mark II": "6D"}
"""The paper's names of its cameras, by those that tables have."""

OWN: Final = ("Given", "Given")
"""Names of pictures and of ground truths of which nothing is said: the paper has no numbers of them."""

NUMBERS: Final = ("Mean", "Med.", "Tri.", "Best 25%", "Worst 25%", "Avg.")
"""Heads of the six numbers of a summary, as in the paper."""


_HEAD: Final = ("scenes", "sensor", "illuminations", "images", "method", "error")
"""What a row of numbers is about, in CSV."""


@dataclass(frozen=True, eq=False)
class Block:
    """One of the eight data sets and what the methods made of it.

    - `cell`: scenes, sensor and illuminations, as the paper names them: ``("C1", "6D", "Random")``; the paper's numbers
      are found by it, so other scenes and lights have names of their own.
    - `images`: number of images.
    - `lights`: how their lights were chosen, in words.
    - `results`: one a method, in the order of `METHODS`.
    """

    cell: Cell
    images: int
    lights: str
    results: tuple[Result, ...]


@dataclass(frozen=True, eq=False)
class Setting:
    """One of the eight data sets before it is evaluated."""

    cell: Cell
    scenes: tuple[RenderedScene, ...]
    lights: str


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
) -> tuple[Setting, ...]:
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
    found: list[Setting] = []
    for scenes, sources in sets.items():
        for lut in luts:
            choices: dict[str, ChosenLights] = {
                names[1]: lights_like(lut, truths, count),
                "Random": lights_at_random(lut, count, seed),
            }
            found += [
                Setting((scenes, sensor_of(lut), lights), rendered(lut, sources, chosen, seed), chosen.how)
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


def table1(
    chosen: Sequence[Setting], workers: int = 1, on_scene: Callable[[], None] | None = None
) -> tuple[Block, ...]:
    """Return what the methods make of each data set."""
    methods = [standard_methods()[name] for name in METHODS]
    return tuple(
        Block(part.cell, len(part.scenes), part.lights, evaluate(part.scenes, methods, workers, on_scene))
        for part in chosen
    )


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
        rows.append((result.method, *result.summary(kind).as_tuple()))
        if result.method in published:
            rows.append(("paper", *published[result.method].as_tuple()))
    notes = [f"{counted(block.images, 'image')}; lights {block.lights}."]
    notes += [
        f"{result.method}: no usable pixel in {counted(int(result.guessed.sum()), 'image')}, whose light "
        "was taken to be grey."
        for result in block.results
        if result.guessed.any()
    ]
    return Table(block_title(block.cell), ("Algorithm", *NUMBERS), tuple(rows), notes=tuple(notes))


def joint_table(blocks: Sequence[Block]) -> Table:
    """Return all data sets, both kinds of error and the paper's numbers as one table, for CSV."""
    kinds: tuple[ErrorKind, ...] = ("reproduction", "recovery")
    rows: list[tuple[str | float | None, ...]] = []
    for block in blocks:
        published = TABLE1.get(block.cell, {})
        for result in block.results:
            head = (*block.cell, block.images, result.method)
            given = {str(kind): result.summary(kind).as_tuple() for kind in kinds}
            if result.method in published:
                given["paper"] = published[result.method].as_tuple()
            rows += [(*head, name, *numbers) for name, numbers in given.items()]
    return Table(
        "Errors on generated data sets, degrees",
        (*_HEAD, "mean", "median", "trimean", "best25", "worst25", "avg"),
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
