"""Compare the errors of two methods, or of one method in two runs, image by image.

Both are on the same images, so everything is paired: Wilcoxon's signed-rank test, recommended for colour constancy by
S. D. Hordley, G. D. Finlayson, JOSA A 23 (2006) 1008-1020; intervals of the differences and ratios of all statistics
(`bootstrap.paired`); and the images on which the two differ most.

Images of one picture or place are not independent. If results say which images belong together, the test is of the
groups' mean errors and the bootstrap draws whole groups: a thousand images of fifteen pictures are fifteen cases.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from markupsafe import Markup
from scipy import stats

from evaluation.experiments.bootstrap import LEVEL, RESAMPLES, STATISTICS, TIE_DEG, Compared, numbered, paired
from evaluation.metrics import ErrorKind
from evaluation.reports.table_output import table_part, table_to_latex
from evaluation.results.files import MethodErrors
from evaluation.results.tables import PAPER_COLUMNS, Cell, Table, table_to_csv
from foundation import pages
from foundation.colorimetry import angles_deg
from foundation.errors import InputError, counted, first_few
from foundation.folders import atomic_folder
from foundation.plots import FAINT, SERIES, draw_svg

# Smaller errors are drawn here: a logarithmic axis has no zero, and no ground truth is known better.
_FLOOR_DEG: Final = 0.01

# Ground truths of the same image are equal but for the rounding of files.
_SAME_TRUTH_DEG: Final = 0.01

_HEADS: Final = dict(zip(STATISTICS, PAPER_COLUMNS[1:], strict=True))

_VALUES: Final = ("Of first", "Of second", "Difference", "from", "to", "Ratio", "ratio from", "ratio to")

METHOD: Final = (
    "Wilcoxon signed-rank test, two-sided; equal errors are ranked and then left out (Pratt).",
    "Effect: matched-pairs rank-biserial correlation, -1: the first errs less on every one; 1: more on every one.",
    "p (Holm) is corrected for all comparisons here. Of groups the mean errors are tested, and counts are of groups.",
)


@dataclass(frozen=True, eq=False)
class Matched:
    """The errors of two methods on the images that both have.

    - `names`: of the two, for tables and figures.
    - `images`: N names, in the first's order, at least one.
    - `one`, `other`: (N,) float64 each, degrees.
    - `groups`: what each image shares with others, such as its picture; None if every image is its own group.
    - `notes`: a sentence for each of the two that lacks images of the other.
    """

    names: tuple[str, str]
    kind: ErrorKind
    images: tuple[str, ...]
    one: npt.NDArray[np.float64]
    other: npt.NDArray[np.float64]
    groups: tuple[str, ...] | None = None
    notes: tuple[str, ...] = ()

    @property
    def sizes(self) -> tuple[int, int]:
        """The number of images, and that of their groups."""
        return len(self.images), len(set(self.groups or self.images))

    @property
    def cases(self) -> str:
        """What the test counts, in words: images, or groups of them."""
        images = counted(len(self.images), "image")
        return images if self.groups is None else f"{counted(self.sizes[1], 'group')} of {images}"

    def case_errors(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Return the errors (M,) float64 of both: the mean of each group, or the images' own."""
        numbers = numbered(self.groups or self.images)
        sizes = np.bincount(numbers)
        return np.bincount(numbers, self.one) / sizes, np.bincount(numbers, self.other) / sizes


@dataclass(frozen=True)
class SignedRank:
    """Wilcoxon's signed-rank test of paired errors.

    - `wins`, `losses`, `ties`: images, or groups of them, on which the one's error is smaller, larger, equal.
    - `p`: two-sided; equal errors are ranked and then left out (J. W. Pratt, JASA 54 (1959) 655-667).
    - `effect`: matched-pairs rank-biserial correlation, (losses - wins) as shares of the rank sum.
    """

    wins: int
    losses: int
    ties: int
    p: float
    effect: float


@dataclass(frozen=True, eq=False)
class Comparison:
    """All results of a pair.

    - `p_holm`: p of the test, corrected for all comparisons made together (`holm`).
    - `statistics`: each statistic of the one against that of the other, with intervals.
    """

    matched: Matched
    test: SignedRank
    p_holm: float
    statistics: tuple[Compared, ...]


def match(one: MethodErrors, other: MethodErrors, names: tuple[str, str], kind: ErrorKind) -> Matched:
    """Return the errors of two methods on the images of the same name."""
    places = {image: place for place, image in enumerate(other.images)}
    both = [(place, places[image]) for place, image in enumerate(one.images) if image in places]
    if not both:
        raise InputError(f"{names[0]} and {names[1]} have no image in common; compare runs on the same data set")
    mine, its = np.array(both, dtype=np.int64).T
    images = tuple(one.images[place] for place in mine.tolist())
    angles = angles_deg(one.truths[mine], other.truths[its])
    worst = int(angles.argmax())
    if angles[worst] > _SAME_TRUTH_DEG:
        raise InputError(
            f"the ground truths of {images[worst]} in {names[0]} and {names[1]} are {angles[worst]:.2f} degrees apart, "
            f"at most {_SAME_TRUTH_DEG:g} expected; run both methods on the same data and ground truths"
        )
    groups: tuple[str, ...] = ()
    for side, chosen in ((other, its), (one, mine)):
        groups = groups if side.groups is None else tuple(side.groups[place] for place in chosen.tolist())
    common = set(images)
    notes: list[str] = []
    for lacking, whose, side in ((*names, other), (*reversed(names), one)):
        missing = [image for image in side.images if image not in common]
        if missing:
            notes.append(
                f"{lacking} lacks {counted(len(missing), 'image')} of {whose}, left out here: {first_few(missing)}"
            )
    known = groups if len(set(groups)) < len(groups) else None
    return Matched(names, kind, images, one.errors[kind][mine], other.errors[kind][its], known, tuple(notes))


def signed_rank(one: npt.ArrayLike, other: npt.ArrayLike) -> SignedRank:
    """Return the signed-rank test of paired errors.

    `one`, `other`: (N,) float each, degrees, in the same order of images, which are independent of each other.

    Examples
    --------
    >>> test = signed_rank([1, 2, 3, 4, 5, 6], [2, 4, 6, 8, 10, 5.5])
    >>> test.wins, test.losses, test.ties, round(test.effect, 3), round(test.p, 4)
    (5, 1, 0, -0.905, 0.0625)
    """
    difference = np.asarray(one, dtype=np.float64) - np.asarray(other, dtype=np.float64)
    difference = np.where(np.abs(difference) < TIE_DEG, 0, difference)
    wins, losses = int((difference < 0).sum()), int((difference > 0).sum())
    if not wins + losses:
        return SignedRank(0, 0, len(difference), 1.0, 0.0)
    ranks = stats.rankdata(np.abs(difference))
    under, over = float(ranks[difference < 0].sum()), float(ranks[difference > 0].sum())
    p = float(stats.wilcoxon(difference, zero_method="pratt").pvalue)
    return SignedRank(wins, losses, len(difference) - wins - losses, p, (over - under) / (over + under))


def holm(probabilities: Sequence[float]) -> list[float]:
    """Return p-values of tests made together, corrected so that one false alarm among all of them has that chance.

    S. Holm, "A simple sequentially rejective multiple test procedure", Scand. J. Statistics 6 (1979) 65-70.

    Examples
    --------
    >>> [round(p, 3) for p in holm([0.01, 0.04, 0.03])]
    [0.03, 0.06, 0.06]
    """
    corrected = [1.0] * len(probabilities)
    least = 0.0
    for rank, place in enumerate(sorted(range(len(probabilities)), key=lambda place: probabilities[place])):
        least = max(least, min(1.0, (len(probabilities) - rank) * probabilities[place]))
        corrected[place] = least
    return corrected


def compare(pairs: Sequence[Matched]) -> tuple[Comparison, ...]:
    """Return the comparison of each pair; their p-values are corrected for one another."""
    tests = [signed_rank(*pair.case_errors()) for pair in pairs]
    corrected = holm([test.p for test in tests])
    return tuple(
        Comparison(pair, test, p, paired(pair.one, pair.other, groups=pair.groups))
        for pair, test, p in zip(pairs, tests, corrected, strict=True)
    )


def verdict(comparison: Comparison) -> str:
    """Return in one sentence which of the two errs less, and whether chance explains it."""
    matched, test = comparison.matched, comparison.test
    one, other = matched.names
    counts = (
        f"{one} errs less than {other} on {test.wins} of {matched.cases}, more on {test.losses}, equal on {test.ties}"
    )
    if comparison.p_holm > 1 - LEVEL:
        return f"{counts}: not significant (Holm-corrected p = {comparison.p_holm:.2g})."
    better = one if test.effect < 0 else other
    return f"{counts}: {better} errs less (Holm-corrected p = {comparison.p_holm:.2g}, effect {test.effect:+.2f})."


def tests_table(comparisons: Sequence[Comparison]) -> Table:
    """Return the signed-rank tests, a row a comparison."""
    return Table(
        f"Paired {comparisons[0].matched.kind} errors",
        ("First", "Second", "p", "p (Holm)", "Effect", "Images", "Groups", "First better", "Second better", "Equal"),
        tuple(
            (*made.matched.names, *_chance(made), *made.matched.sizes, made.test.wins, made.test.losses, made.test.ties)
            for made in comparisons
        ),
        notes=METHOD,
    )


def _chance(made: Comparison) -> tuple[str, str, float]:
    return f"{made.test.p:.2g}", f"{made.p_holm:.2g}", made.test.effect


def statistics_table(comparisons: Sequence[Comparison]) -> Table:
    """Return every statistic of comparisons, with difference and ratio."""
    return Table(
        f"Statistics of {comparisons[0].matched.kind} errors, degrees",
        ("First", "Second", "Statistic", *_VALUES),
        tuple(
            (*made.matched.names, _HEADS[one.statistic], one.one, one.other, *_cells(*one.difference, *one.ratio))
            for made in comparisons
            for one in made.statistics
        ),
        digits=3,
        notes=(
            f"Intervals of {LEVEL:.0%}: BCa bootstrap over images, or groups of images, {RESAMPLES} resamples, the "
            "same for both. None for a single group, which says nothing of others.",
        ),
    )


def images_table(comparison: Comparison, count: int = 10) -> Table:
    """Return the images on which the two differ most, the largest difference first; equal errors are left out."""
    matched = comparison.matched
    one, other = matched.one.tolist(), matched.other.tolist()
    size = np.abs(matched.one - matched.other)
    largest = [place for place in np.argsort(-size, kind="stable")[:count].tolist() if size[place] >= TIE_DEG]
    return Table(
        "{} against {}: the largest differences, degrees".format(*matched.names),
        ("Image", "First", "Second", "Difference"),
        tuple((matched.images[place], one[place], other[place], one[place] - other[place]) for place in largest),
    )


def error_scatter(matched: Matched) -> bytes:
    """Return a figure as SVG: the error of the other against that of the one, with the line of equal errors."""

    def draw(figure: Any) -> None:
        x, y = np.maximum(matched.one, _FLOOR_DEG), np.maximum(matched.other, _FLOOR_DEG)
        ends = [min(x.min(), y.min()) / 1.15, max(x.max(), y.max()) * 1.15]
        axes = figure.add_subplot()
        axes.plot(ends, ends, color=FAINT, linewidth=1, zorder=1)
        for colour, chosen in ((SERIES[0], x <= y), (SERIES[1], x > y)):
            axes.scatter(x[chosen], y[chosen], s=14, color=colour, alpha=0.8, linewidths=0, zorder=2)
        labels = [f"{name}: error, degrees" for name in matched.names]
        axes.set(xscale="log", yscale="log", xlim=ends, ylim=ends, aspect="equal", xlabel=labels[0], ylabel=labels[1])
        axes.xaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_major_formatter("{x:g}")

    return draw_svg(draw, inches=(5.6, 5.4))


def comparison_page(comparisons: Sequence[Comparison], notes: Sequence[str]) -> str:
    """Return the HTML page of comparisons."""
    parts: list[Markup] = [pages.paragraph(text) for text in (*notes, *map(verdict, comparisons))]
    parts += [table_part(tests_table(comparisons)), table_part(statistics_table(comparisons))]
    for made in comparisons:
        one, other = made.matched.names
        caption = f"An image a point: above the line (blue) {one} errs less, below it (orange) more."
        figure = pages.figure(error_scatter(made.matched), caption)
        parts += [pages.heading(f"{one} against {other}"), pages.row([figure, table_part(images_table(made, 10))])]
    return pages.page(f"Comparison of {comparisons[0].matched.kind} errors", parts)


def _cells(*numbers: float) -> list[Cell]:
    """Return numbers as cells: None for NaN; a ratio's upper end may be infinite."""
    return [None if np.isnan(number) else number for number in numbers]


def write_comparisons(folder: Path, comparisons: Sequence[Comparison], notes: Sequence[str]) -> None:
    """Write a new folder: `tests.csv`, `statistics.csv`, `tables.tex` and `report.html`."""
    tables = {"tests.csv": tests_table(comparisons), "statistics.csv": statistics_table(comparisons)}
    texts = {name: table_to_csv(table) for name, table in tables.items()}
    texts["tables.tex"] = "\n".join(map(table_to_latex, tables.values()))
    texts["report.html"] = comparison_page(comparisons, notes)
    with atomic_folder(folder, "the comparison") as place:
        for name, text in texts.items():
            (place / name).write_text(text, encoding="utf-8")
