"""Compare the errors of two methods, or of one method in two runs, image by image.

The same images lie under both, so everything is paired: the signed-rank test (F. Wilcoxon, "Individual comparisons by
ranking methods", Biometrics Bulletin 1 (1945) 80-83), whose recommendation for colour constancy is S. D. Hordley,
G. D. Finlayson, "Reevaluation of color constancy algorithm performance", JOSA A 23 (2006) 1008-1020; intervals of the
differences and ratios of all statistics (`bootstrap.paired`); and the images on which the two differ most.

Images of one picture or place are no independent images. Where results say which belong together, the test is of the
groups' mean errors and the bootstrap draws whole groups: a thousand images of fifteen pictures are fifteen cases.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from markupsafe import Markup

from evaluation.experiments.bootstrap import STATISTICS, Compared, numbered, paired
from evaluation.metrics import ErrorKind
from evaluation.reports.table_output import table_part, tables_to_latex
from evaluation.results.files import MethodErrors
from evaluation.results.result import csv_text
from evaluation.results.tables import PAPER_COLUMNS, Table, table_to_csv
from foundation import pages
from foundation.colorimetry import angles_deg
from foundation.errors import InputError, counted
from foundation.folders import whole_folder
from foundation.plots import FAINT, INK, SERIES, svg_of

FLOOR_DEG: Final = 0.01
"""Smaller errors are drawn here: a logarithmic axis has no zero, and no ground truth is known as well."""

_DECADE: Final = 10.0
"""Points on the two axes stay apart by at least this factor, so that close errors do not fill the figure."""

_AXES_PT: Final = 330.0
"""Height of the scatter's axes, about, in typographic points; it is 5.4 inches with its labels."""
_LABEL_PT, _LABEL_RISE_PT = 8.5, 3.0
"""Height of a label of 7 points, and by how much one stands above its point."""


def error_scatter(
    one: npt.NDArray[np.float64], other: npt.NDArray[np.float64], names: tuple[str, str], marked: dict[int, str]
) -> bytes:
    """Return a figure as SVG: the error of the other against that of the one, with the line where they are equal.

    `one`, `other`: (N,) float64 each, degrees, in the same order of images.
    """

    def draw(figure: Any) -> None:
        x, y = np.maximum(one, FLOOR_DEG), np.maximum(other, FLOOR_DEG)
        low, high = float(min(x.min(), y.min())) / 1.15, float(max(x.max(), y.max())) * 1.15
        middle = np.sqrt(low * high)
        low, high = min(low, middle / _DECADE**0.5), max(high, middle * _DECADE**0.5)
        axes = figure.add_subplot()
        axes.plot([low, high], [low, high], color=FAINT, linewidth=1, zorder=1)
        for colour, chosen in ((SERIES[0], one <= other), (SERIES[1], one > other)):
            axes.scatter(x[chosen], y[chosen], s=14, color=colour, alpha=0.8, linewidths=0, zorder=2)
        places = np.array(list(marked), dtype=np.int64)
        axes.scatter(x[places], y[places], s=34, facecolors="none", edgecolors=INK, linewidths=0.8, zorder=3)
        for place, rise in zip(marked, _rises(x[places], y[places], low, high), strict=True):
            left = x[place] > middle
            axes.annotate(
                marked[place],
                (x[place], y[place]),
                xytext=(-5 if left else 5, rise),
                textcoords="offset points",
                ha="right" if left else "left",
                fontsize=7,
                color=INK,
                arrowprops={"arrowstyle": "-", "color": FAINT, "linewidth": 0.5, "shrinkA": 0, "shrinkB": 2.5},
            )
        axes.set(
            xscale="log",
            yscale="log",
            xlim=(low, high),
            ylim=(low, high),
            aspect="equal",
            xlabel=f"{names[0]}: error, degrees",
            ylabel=f"{names[1]}: error, degrees",
        )
        axes.xaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_major_formatter("{x:g}")

    return svg_of(draw, inches=(5.6, 5.4))


def _rises(x: npt.NDArray[np.float64], y: npt.NDArray[np.float64], low: float, high: float) -> npt.NDArray[np.float64]:
    """Return by how much labels stand above their points, typographic points, so that none covers another.

    `x`, `y`: (N,) float64, between `low` and `high` of logarithmic axes. Those of each quarter of the figure are piled
    up from its outer edge to the middle.
    """
    middle = np.sqrt(low * high)
    heights = _AXES_PT * np.log(y / low) / np.log(high / low)
    places = heights + _LABEL_RISE_PT
    for left in (False, True):
        for inward, upper in ((1, False), (-1, True)):
            quarter = np.flatnonzero(((x > middle) == left) & ((y > middle) == upper))
            quarter = quarter[np.argsort(inward * heights[quarter])]
            for before, after in pairwise(quarter):
                places[after] = inward * max(inward * places[after], inward * places[before] + _LABEL_PT)
    return places - heights


_SAME_TRUTH_DEG: Final = 0.01
"""Truths that differ by less are the same light written with few digits; six decimals are good to .0001 degrees."""

_TIE_DEG: Final = 2e-6
"""Errors that differ by less are equal: files hold six decimals, and machines differ in the last ones."""

_NAMED: Final = 5
"""Images named in a message; of more, the number is told."""


@dataclass(frozen=True, eq=False)
class Matched:
    """The errors of two methods on the images that both have.

    - `names`: of the two, for tables and figures.
    - `images`: N names, in the first's order, at least one.
    - `one`, `other`: (N,) float64 each, degrees.
    - `missing`: images that only the other has, and images that only the one has.
    - `groups`: what each image shares with others, such as its picture; None if every image is one of its own, or
      neither says.
    """

    names: tuple[str, str]
    kind: ErrorKind
    images: tuple[str, ...]
    one: npt.NDArray[np.float64]
    other: npt.NDArray[np.float64]
    missing: tuple[tuple[str, ...], tuple[str, ...]] = ((), ())
    groups: tuple[str, ...] | None = None

    @property
    def cases(self) -> str:
        """What is independent, and counted by the test, in words."""
        images = counted(len(self.images), "image")
        return images if self.groups is None else f"{counted(len(set(self.groups)), 'group')} of {images}"

    def case_errors(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Return the errors of both, (C,) float64 each, degrees: a mean for each group, or the images' own."""
        if self.groups is None:
            return self.one, self.other
        numbers = numbered(self.groups)
        sizes = np.bincount(numbers)
        return np.bincount(numbers, self.one) / sizes, np.bincount(numbers, self.other) / sizes


@dataclass(frozen=True)
class SignedRank:
    """Wilcoxon's signed-rank test of paired errors.

    - `wins`, `losses`, `ties`: images, or groups of them, on which the one's error is smaller, larger, equal.
    - `p`: two-sided probability of a rank sum as uneven as this where neither is better. Equal errors are ranked and
      then left out (J. W. Pratt, JASA 54 (1959) 655-667). Exact up to 50 images where none are equal, else from the
      normal distribution that the rank sum tends to, corrected for ties.
    - `effect`: matched-pairs rank-biserial correlation (D. S. Kerby, Comprehensive Psychology 3 (2014)): (losses -
      wins) / all as shares of the rank sum; -1 where the one is better on every one, 0 where neither is, 1 where it
      is worse.
    """

    wins: int
    losses: int
    ties: int
    p: float
    effect: float


@dataclass(frozen=True, eq=False)
class Comparison:
    """All that is said of a pair.

    - `test`: their signed-rank test.
    - `p_holm`: its p among those of all comparisons made together (`holm`).
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
        raise InputError(
            f"{names[0]} and {names[1]} have no image in common, they begin with {one.images[0]} and "
            f"{other.images[0]}; compare runs on the same data set"
        )
    mine, its = (np.array(side, dtype=np.int64) for side in zip(*both, strict=True))
    if one.truths is not None and other.truths is not None:
        angles = angles_deg(one.truths[mine], other.truths[its])
        worst = int(angles.argmax())
        if angles[worst] > _SAME_TRUTH_DEG:
            raise InputError(
                f"the ground truths of {one.images[both[worst][0]]} in {names[0]} and {names[1]} are "
                f"{angles[worst]:.2f} degrees apart, those of {int((angles > _SAME_TRUTH_DEG).sum())} of {len(both)} "
                f"images more than {_SAME_TRUTH_DEG:g}: the runs are of different data or ground truths; run both on "
                "the same"
            )
    here = set(one.images)
    known: tuple[str, ...] = ()
    for side, chosen in ((other, [place for _, place in both]), (one, [place for place, _ in both])):
        known = known if side.groups is None else tuple(side.groups[place] for place in chosen)
    return Matched(
        names=names,
        kind=kind,
        images=tuple(one.images[place] for place, _ in both),
        one=one.errors[kind][mine],
        other=other.errors[kind][its],
        missing=(
            tuple(image for image in other.images if image not in here),
            tuple(image for image in one.images if image not in places),
        ),
        groups=known if len(set(known)) < len(known) else None,
    )


def signed_rank(one: npt.ArrayLike, other: npt.ArrayLike) -> SignedRank:
    """Return the signed-rank test of paired errors.

    `one`, `other`: (N,) float each, degrees, in the same order of images, which are independent of each other.

    Examples
    --------
    >>> test = signed_rank([1, 2, 3, 4, 5, 6], [2, 4, 6, 8, 10, 5.5])
    >>> test.wins, test.losses, test.ties, round(test.effect, 3), round(test.p, 4)
    (5, 1, 0, -0.905, 0.0625)
    """
    from scipy import stats

    difference = np.asarray(one, dtype=np.float64) - np.asarray(other, dtype=np.float64)
    difference = np.where(np.abs(difference) < _TIE_DEG, 0, difference)
    wins, losses = int((difference < 0).sum()), int((difference > 0).sum())
    if not wins + losses:
        return SignedRank(0, 0, len(difference), 1.0, 0.0)
    ranks = stats.rankdata(np.abs(difference))
    under, over = float(ranks[difference < 0].sum()), float(ranks[difference > 0].sum())
    p = stats.wilcoxon(difference, zero_method="pratt").pvalue
    return SignedRank(wins, losses, len(difference) - wins - losses, float(p), (over - under) / (over + under))


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


def compare(pairs: Sequence[Matched], seed: int = 0, level: float = 0.95) -> tuple[Comparison, ...]:
    """Return the comparison of each pair; their p-values are corrected for one another."""
    tests = [signed_rank(*pair.case_errors()) for pair in pairs]
    corrected = holm([test.p for test in tests])
    return tuple(
        Comparison(pair, test, p, paired(pair.one, pair.other, seed, level=level, groups=pair.groups))
        for pair, test, p in zip(pairs, tests, corrected, strict=True)
    )


def largest_differences(matched: Matched, count: int = 10) -> list[int]:
    """Return the places of the images on which the two differ most, by the size of the difference, the largest first.

    Images with equal errors are left out; of equal differences the first image comes first.
    """
    size = np.abs(matched.one - matched.other)
    order = np.argsort(-size, kind="stable")
    return [int(place) for place in order[:count] if size[place] >= _TIE_DEG]


def verdict(comparison: Comparison, level: float = 0.95) -> str:
    """Return in one sentence what a comparison says, and whether chance would explain it."""
    matched, test = comparison.matched, comparison.test
    one, other = matched.names
    told = f"{one} errs less than {other} on {test.wins} of {matched.cases}, more on {test.losses}"
    told += f", the same on {test.ties}" if test.ties else ""
    if comparison.p_holm > 1 - level:
        return f"{told}: not significant (Holm-corrected p = {comparison.p_holm:.2g})."
    better = one if test.effect < 0 else other
    return f"{told}: {better} errs less (Holm-corrected p = {comparison.p_holm:.2g}, effect {test.effect:+.2f})."


def missing_images(matched: Matched) -> tuple[str, ...]:
    """Return a sentence for each of the two that lacks images of the other."""
    return tuple(
        f"{name} lacks {counted(len(lacking), 'image')} of {whose}, left out here: {_listed(lacking)}"
        for name, whose, lacking in zip(matched.names, reversed(matched.names), matched.missing, strict=True)
        if lacking
    )


def _listed(names: Sequence[str]) -> str:
    rest = len(names) - _NAMED
    return ", ".join(names[:_NAMED]) + (f" and {rest} more" if rest > 0 else "")


_HEADS = dict(zip(STATISTICS, PAPER_COLUMNS[1:], strict=True))
"""Statistics as every other table heads them; files keep the short names."""

_LABELLED = 5
"""Images labelled in a scatter: more names would cover one another."""

METHOD = (
    "Wilcoxon signed-rank test, two-sided; equal errors are ranked and then left out (Pratt).",
    "Effect: matched-pairs rank-biserial correlation, -1: the first errs less on every one; 1: more on every one.",
)
"""What the numbers of `tests_table` are."""

GROUPED = (
    "Images of one group, such as one picture under several lights, are not independent: tested are the groups' mean "
    "errors, and counts are of groups."
)
"""What they are besides where images belong together."""


def tests_table(comparisons: Sequence[Comparison]) -> Table:
    """Return the signed-rank tests, a row a comparison."""
    several = len(comparisons) > 1
    grouped = any(made.matched.groups is not None for made in comparisons)
    notes = (
        *METHOD,
        *((f"p (Holm) is corrected for the {len(comparisons)} comparisons here.",) if several else ()),
        *((GROUPED,) if grouped else ()),
    )
    heads = ("First", "Second", "p", "p (Holm)", "Effect", "Images", *(("Groups",) if grouped else ()))
    return Table(
        f"Paired {comparisons[0].matched.kind} errors",
        (*heads, "First better", "Second better", "Equal"),
        tuple(
            (
                *made.matched.names,
                f"{made.test.p:.2g}",
                f"{made.p_holm:.2g}",
                made.test.effect,
                len(made.matched.images),
                *([len(set(made.matched.groups or made.matched.images))] if grouped else []),
                made.test.wins,
                made.test.losses,
                made.test.ties,
            )
            for made in comparisons
        ),
        notes=notes,
    )


def statistics_table(comparison: Comparison, level: float) -> Table:
    """Return every statistic of one comparison, with difference and ratio."""
    one, other = comparison.matched.names
    matched = comparison.matched
    over = "images" if matched.groups is None else "groups of images"
    single = matched.groups is not None and len(set(matched.groups)) == 1
    return Table(
        f"{one} against {other}: {matched.kind} errors of {matched.cases}, degrees",
        ("Statistic", "First", "Second", "Difference", "from", "to", "Ratio", "ratio from", "ratio to"),
        tuple(
            (_HEADS[made.statistic], made.one, made.other, *map(_known, (*made.difference, *made.ratio)))
            for made in comparison.statistics
        ),
        digits=3,
        notes=(
            "No intervals: all images are of one group, and what it comes to says nothing of others."
            if single
            else f"Intervals of {level:.0%}: BCa bootstrap over {over}, 2000 resamples, the same for both.",
        ),
    )


def images_table(comparison: Comparison, count: int = 10) -> Table:
    """Return the images on which the two differ most."""
    matched = comparison.matched
    return Table(
        f"{matched.names[0]} against {matched.names[1]}: the largest differences, degrees",
        ("Image", "First", "Second", "Difference"),
        tuple(
            (matched.images[place], one, other, one - other)
            for place in largest_differences(matched, count)
            for one, other in [(float(matched.one[place]), float(matched.other[place]))]
        ),
    )


def comparison_page(comparisons: Sequence[Comparison], notes: Sequence[str], level: float) -> str:
    """Return the HTML page of comparisons."""
    parts: list[Markup] = [*(pages.paragraph(note) for note in notes)]
    parts += [pages.paragraph(verdict(made, level)) for made in comparisons]
    parts.append(table_part(tests_table(comparisons)))
    for made in comparisons:
        matched = made.matched
        marked = {place: matched.images[place] for place in largest_differences(matched, _LABELLED)}
        picture = error_scatter(matched.one, matched.other, matched.names, marked)
        caption = (
            f"An image a point: above the line (blue) {matched.names[0]} errs less, below it (orange) more. The images "
            f"with the largest differences are named. Errors below {FLOOR_DEG:g} degrees are drawn there."
        )
        parts += [
            pages.heading(f"{matched.names[0]} against {matched.names[1]}"),
            table_part(statistics_table(made, level)),
            pages.row([pages.figure(picture, caption), table_part(images_table(made))]),
        ]
    return pages.page(_title(comparisons), parts)


def write_comparisons(folder: Path, comparisons: Sequence[Comparison], notes: Sequence[str], level: float) -> None:
    """Write a new folder: `tests.csv`, `statistics.csv`, `images.csv`, `tables.tex` and `report.html`."""
    with whole_folder(folder, "the comparison") as place:
        (place / "tests.csv").write_text(table_to_csv(tests_table(comparisons)), encoding="utf-8")
        (place / "statistics.csv").write_text(_statistics_csv(comparisons), encoding="utf-8")
        (place / "images.csv").write_text(_images_csv(comparisons), encoding="utf-8")
        tables = [tests_table(comparisons)]
        tables += [statistics_table(made, level) for made in comparisons]
        text = "\n".join(tables_to_latex(table.title, [table]) for table in tables)
        (place / "tables.tex").write_text(text, encoding="utf-8")
        (place / "report.html").write_text(comparison_page(comparisons, notes, level), encoding="utf-8")


def notes_of(comparisons: Sequence[Comparison]) -> tuple[str, ...]:
    """Return the sentences on images that are missing, each once."""
    return tuple(dict.fromkeys(note for made in comparisons for note in missing_images(made.matched)))


def _known(number: float) -> float | None:
    """Return a number as a cell has it: None for NaN; a ratio's upper end may be infinite."""
    return None if np.isnan(number) else number


def _title(comparisons: Sequence[Comparison]) -> str:
    if len(comparisons) == 1:
        return "{} against {}".format(*comparisons[0].matched.names)
    return f"{len(comparisons)} comparisons of {comparisons[0].matched.kind} errors"


def _statistics_csv(comparisons: Sequence[Comparison]) -> str:
    heads = ("difference", "difference_low", "difference_high", "ratio", "ratio_low", "ratio_high")
    rows = tuple(
        (
            *made.matched.names,
            compared.statistic,
            compared.one,
            compared.other,
            *map(_known, (*compared.difference, *compared.ratio)),
        )
        for made in comparisons
        for compared in made.statistics
    )
    return table_to_csv(Table("", ("first", "second", "statistic", "first_deg", "second_deg", *heads), rows))


def _images_csv(comparisons: Sequence[Comparison]) -> str:
    heads = ("first", "second", "image", "first_deg", "second_deg", "difference_deg", "group")
    rows: list[tuple[str, ...]] = [heads]
    for made in comparisons:
        matched = made.matched
        groups = matched.groups or matched.images
        for image, one, other, group in zip(matched.images, matched.one, matched.other, groups, strict=True):
            numbers = (f"{number:.6f}" for number in (one, other, one - other))
            rows.append((*matched.names, image, *numbers, group))
    return csv_text(rows)
