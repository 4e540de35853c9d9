"""The paper's second table: learned methods trained on real and on generated images, tested on the real ones (4.4).

Trained on real: by cross-validation, each image's light estimated by a method that has not seen it. Trained on
generated: fitted once to all generated images. Both are tested on the same real images. The paper has Cube+ for the
real ones, of which it states neither folds nor seeds; other data sets give the same table without the paper's numbers
beside it, and `evaluate transfer` compares more.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from evaluation.experiments.cross_validation import cross_validate
from evaluation.experiments.paper.published import TABLE2
from evaluation.experiments.paper.table1 import NUMBERS
from evaluation.experiments.running import evaluate, fit_anew
from evaluation.methods.method import Learner
from evaluation.metrics import ErrorKind
from evaluation.results.result import Result
from evaluation.results.tables import Table
from evaluation.scene import Scene
from foundation.errors import InputError

LEARNERS: Final[Mapping[str, str]] = {
    "regression-trees": "Regression trees (simple features)",
    "smart-color-cat": "Smart Color Cat",
    "color-beaver": "Color Beaver (using Gray-world)",
}
"""The learners of the table: our short names, and the paper's names."""


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
    fitted = [fit_anew(learner, generated, seed) for learner in chosen]
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
            rows.append((result.method, *result.summary(kind).as_tuple()))
            known = published.get(LEARNERS.get(trained.learner, ""))
            if known and with_published:
                rows.append(("paper", *known.as_tuple()))
        tables.append(Table(title, ("Algorithm", *NUMBERS), tuple(rows)))
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
