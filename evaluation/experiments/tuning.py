"""Which parameters of a method suit the images of a data set, found without their ground truths.

The criterion is that of `methods.green_stability`. Ground truths are read only where errors are asked for, and then to
stand beside the criterion: the choice is made before.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
import numpy.typing as npt

from evaluation.experiments.running import require_truths
from evaluation.methods.green_stability import choose, counted, family_names, lights_of, require_enough
from evaluation.methods.method import Method
from evaluation.methods.naming import find_method
from evaluation.metrics import ErrorKind, Summary, recovery_error, reproduction_error, summarise
from evaluation.results.tables import Cell, Table
from evaluation.scene import Scene
from foundation.processors import ordered_map


@dataclass(frozen=True)
class FamilySetting:
    """One set of parameters of a family, and how it did.

    - `text`: what `--method` takes for it: "gray-edge-1:p=4:sigma=2".
    - `name`: the method's name in tables.
    - `spread`: standard deviation of the green chromaticity g / (r + g + b) of its estimates.
    - `errors`: its errors on the images that count, degrees; None where nobody asked.
    """

    text: str
    name: str
    spread: float
    errors: Summary | None


@dataclass(frozen=True)
class Tuning:
    """What tuning a family on a data set found.

    - `family`: what was asked for: "gray-edge-1", or "gray-edge-1@360".
    - `data`: the data set's name.
    - `settings`: all sets of parameters, the chosen one first, by rising spread.
    - `images`, `counted`: number of images, and of those for which every setting gives a light: the others do not
      count.
    - `kind`: which errors stand beside; None if none do.
    """

    family: str
    data: str
    settings: tuple[FamilySetting, ...]
    images: int
    counted: int
    kind: ErrorKind | None


def settings_of(family: str) -> tuple[tuple[str, Method], ...]:
    """Return what `--method` takes for each set of parameters of a family, and its method.

    Examples
    --------
    >>> [(text, method.name) for text, method in settings_of("shades-of-gray@90")][1]
    ('shades-of-gray:p=2@90', 'Shades-of-Gray (p=2) at 90 px')
    """
    name, at, around = family.strip().partition("@")
    texts = (f"{text}{at}{around}" for text in family_names(name))
    return tuple((text, cast("Method", find_method(text))) for text in texts)


def tune_family(
    family: str,
    data: str,
    scenes: Sequence[Scene],
    kind: ErrorKind | None = None,
    workers: int = 1,
    on_scene: Callable[[], None] | None = None,
) -> Tuning:
    """Return the sets of parameters of a family by how much their estimates spread in green chromaticity.

    `kind`: which errors to state beside; None reads no ground truth.
    """
    texts, methods = zip(*settings_of(family), strict=True)
    require_enough(len(methods), len(scenes))
    found: list[npt.NDArray[np.float64]] = []
    for one in ordered_map(lambda scene: lights_of(methods, scene), scenes, workers):
        found.append(one)
        if on_scene:
            on_scene()
    lights = np.stack(found)
    tuned = choose(methods, lights)
    errors: list[Summary | None] = [None] * len(methods)
    if kind is not None:
        which = counted(lights)
        truths = require_truths(scenes, methods)[which]
        measure = recovery_error if kind == "recovery" else reproduction_error
        errors = [summarise(measure(lights[which, place], truths)) for place in range(len(methods))]
    settings = [
        FamilySetting(text, method.name, spread, error)
        for text, method, spread, error in zip(texts, methods, tuned.spreads, errors, strict=True)
    ]
    return Tuning(
        family,
        data,
        tuple(sorted(settings, key=lambda setting: setting.spread)),
        len(scenes),
        tuned.images,
        kind,
    )


def tuning_table(tuning: Tuning) -> Table:
    """Return the table of settings for people: spreads in thousandths, errors in degrees."""
    heads = ("Mean", "Med.", "Tri.", "Best 25%", "Worst 25%", "Avg.") if tuning.kind else ()
    what = f"; {tuning.kind} angular error, degrees" if tuning.kind else ""
    notes: list[str] = []
    if tuning.counted < tuning.images:
        notes.append(
            f"{tuning.images - tuning.counted} of {tuning.images} images give no light with some setting and do not "
            "count for any."
        )
    return Table(
        f"{tuning.data}: {tuning.family} by the spread of green chromaticity on {tuning.counted} images, "
        f"thousandths{what}",
        ("Setting", "Spread", *heads),
        tuple((one.text, 1000 * one.spread, *_errors(one)) for one in tuning.settings),
        digits=2,
        notes=tuple(notes),
    )


def tuning_rows(tuning: Tuning) -> Table:
    """Return the table of settings for programs: the chosen one has rank 1; spreads are in chromaticity, 0 … 1."""
    heads = [f"{tuning.kind}_{name}" for name in ("mean", "median", "trimean", "best25", "worst25", "avg")]
    return Table(
        tuning.family,
        ("rank", "setting", "method", "green_spread", "images", *(heads if tuning.kind else ())),
        tuple(
            (rank, one.text, one.name, one.spread, tuning.counted, *_errors(one))
            for rank, one in enumerate(tuning.settings, 1)
        ),
    )


def _errors(setting: FamilySetting) -> tuple[Cell, ...]:
    return () if setting.errors is None else setting.errors.as_tuple()
