"""Compare the errors of two methods, or of one method in two runs, image by image.

Errors on the same image are paired. Wilcoxon's signed-rank test is recommended for colour constancy by S. D. Hordley,
G. D. Finlayson, JOSA A 23 (2006) 1008-1020. Differences and ratios of all statistics have confidence intervals
(`bootstrap.compare_paired`).

Images of the same picture or scene are not independent. If results have groups, the test uses the mean error of each
group, and the bootstrap draws whole groups. 1000 images of 15 pictures then count as 15 cases.
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

from evaluation.experiments import bootstrap
from evaluation.experiments.bootstrap import LEVEL, STATISTICS, TIE_DEG, PairedFigure, group_ids
from evaluation.metrics import ErrorKind
from evaluation.reports.table_output import table_part, table_to_latex
from evaluation.results.files import MethodErrors
from evaluation.results.tables import ERROR_COLUMNS, Cell, Table, table_to_csv
from foundation import pages
from foundation.colorimetry import angles_deg
from foundation.errors import InputError, counted, first_few
from foundation.folders import atomic_folder
from foundation.plots import FAINT, SERIES, FigureForm, draw_svg

# Smaller errors are drawn at this value, degrees: a logarithmic axis has no zero, and no ground truth is more accurate.
_FLOOR_DEG: Final = 0.01

# Largest accepted angle between two ground truths of the same image, degrees. Files round ground truths differently.
_SAME_TRUTH_DEG: Final = 0.01

_STATISTIC_HEADS: Final = dict(zip(STATISTICS, ERROR_COLUMNS[1:], strict=True))

_VALUE_HEADS: Final = ("Of first", "Of second", "Difference", "from", "to", "Ratio", "ratio from", "ratio to")

# With more comparisons than this, the terminal shows no details, and the page folds them.
MAX_DETAILED: Final = 3

TEST_NOTES: Final = (
    "Wilcoxon signed-rank test, two-sided; equal errors are ranked, then excluded (Pratt).",
    "Effect: matched-pairs rank-biserial correlation; -1: the first is better on every image, 1: worse on every image.",
    "p (Holm) is corrected for all comparisons here. With groups, mean errors of groups are tested and counted.",
)


@dataclass(frozen=True, eq=False)
class MatchedErrors:
    """Errors of two methods on their common images."""

    names: tuple[str, str]  # For tables and figures
    metric: ErrorKind
    images: tuple[str, ...]  # N names, in the order of the first method, at least one
    # Both (N,) float64, degrees
    errors_a: npt.NDArray[np.float64]
    errors_b: npt.NDArray[np.float64]
    # Group of each image, such as its source picture; None if every image is its own group
    groups: tuple[str, ...] | None = None
    notes: tuple[str, ...] = ()  # A sentence for each method without errors on some images of the other method

    @property
    def sizes(self) -> tuple[int, int]:
        """Number of images, and number of their groups."""
        return len(self.images), len(set(self.groups or self.images))

    @property
    def cases(self) -> str:
        """Text that counts the cases of the test: images, or groups of images."""
        images = counted(len(self.images), "image")
        return images if self.groups is None else f"{counted(self.sizes[1], 'group')} of {images}"

    def case_errors(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Return for both methods the mean error of each group, or the error of each image, (M,) float64."""
        numbers = group_ids(self.groups or self.images)
        sizes = np.bincount(numbers)
        return np.bincount(numbers, self.errors_a) / sizes, np.bincount(numbers, self.errors_b) / sizes


@dataclass(frozen=True)
class SignedRank:
    """Wilcoxon's signed-rank test of paired errors."""

    # Number of images, or of groups, with a smaller, larger and equal error of the first method
    wins: int
    losses: int
    ties: int
    p: float  # Two-sided; equal errors are ranked, then excluded (J. W. Pratt, JASA 54 (1959) 655-667).
    effect: float  # Matched-pairs rank-biserial correlation, (rank sum of losses - rank sum of wins) / sum of all ranks


@dataclass(frozen=True, eq=False)
class Comparison:
    """All results for a pair of methods."""

    matched: MatchedErrors
    test: SignedRank
    p_holm: float  # p of the test, corrected for all comparisons made together (`holm`)
    statistics: tuple[PairedFigure, ...]  # Every statistic of both methods, with intervals of difference and ratio


def match(first: MethodErrors, second: MethodErrors, names: tuple[str, str], metric: ErrorKind) -> MatchedErrors:
    """Return the errors of two methods on the images with the same name."""
    index_of = {image: index for index, image in enumerate(second.images)}
    pairs = [(index, index_of[image]) for index, image in enumerate(first.images) if image in index_of]
    if not pairs:
        raise InputError(f"{names[0]} and {names[1]} have 0 common images, expected 1 or more; use one data set")
    indices_a, indices_b = np.array(pairs, dtype=np.int64).T
    images = tuple(first.images[index] for index in indices_a.tolist())
    angles = angles_deg(first.truths[indices_a], second.truths[indices_b])
    worst = int(angles.argmax())
    if angles[worst] > _SAME_TRUTH_DEG:
        raise InputError(
            f"the ground truths of {images[worst]} in {names[0]} and {names[1]} differ by {angles[worst]:.2f} degrees, "
            f"expected at most {_SAME_TRUTH_DEG:g}; run both methods on the same data and ground truths"
        )
    # Groups of the first method are used if it has groups, else groups of the second method.
    groups: tuple[str, ...] = ()
    for source, indices in ((second, indices_b), (first, indices_a)):
        groups = groups if source.groups is None else tuple(source.groups[index] for index in indices.tolist())
    common = set(images)
    notes: list[str] = []
    for name, other_name, source in ((*names, second), (*reversed(names), first)):
        missing = [image for image in source.images if image not in common]
        if missing:
            notes.append(
                f"{name} lacks {counted(len(missing), 'image')} of {other_name}, excluded here: {first_few(missing)}"
            )
    used_groups = groups if len(set(groups)) < len(groups) else None
    errors_a, errors_b = first.errors[metric][indices_a], second.errors[metric][indices_b]
    return MatchedErrors(names, metric, images, errors_a, errors_b, used_groups, tuple(notes))


def signed_rank(errors_a: npt.ArrayLike, errors_b: npt.ArrayLike) -> SignedRank:
    """Return the signed-rank test of paired errors.

    `errors_a`, `errors_b`: (N,) float, degrees, in the same order of images. The images must be independent.

    Examples
    --------
    >>> test = signed_rank([1, 2, 3, 4, 5, 6], [2, 4, 6, 8, 10, 5.5])
    >>> test.wins, test.losses, test.ties, round(test.effect, 3), round(test.p, 4)
    (5, 1, 0, -0.905, 0.0625)
    """
    difference = np.asarray(errors_a, dtype=np.float64) - np.asarray(errors_b, dtype=np.float64)
    difference = np.where(np.abs(difference) < TIE_DEG, 0, difference)
    wins, losses = int((difference < 0).sum()), int((difference > 0).sum())
    if not wins + losses:
        return SignedRank(0, 0, len(difference), 1.0, 0.0)
    ranks = stats.rankdata(np.abs(difference))
    win_ranks, loss_ranks = float(ranks[difference < 0].sum()), float(ranks[difference > 0].sum())
    p = float(stats.wilcoxon(difference, zero_method="pratt").pvalue)
    effect = (loss_ranks - win_ranks) / (loss_ranks + win_ranks)
    return SignedRank(wins, losses, len(difference) - wins - losses, p, effect)


def holm(probabilities: Sequence[float]) -> list[float]:
    """Return p-values that are corrected for several tests, so that all tests together have the level of one test.

    S. Holm, "A simple sequentially rejective multiple test procedure", Scand. J. Statistics 6 (1979) 65-70.

    Examples
    --------
    >>> [round(p, 3) for p in holm([0.01, 0.04, 0.03])]
    [0.03, 0.06, 0.06]
    """
    corrected = [1.0] * len(probabilities)
    largest = 0.0
    for rank, index in enumerate(sorted(range(len(probabilities)), key=lambda index: probabilities[index])):
        largest = max(largest, min(1.0, (len(probabilities) - rank) * probabilities[index]))
        corrected[index] = largest
    return corrected


def compare(pairs: Sequence[MatchedErrors]) -> tuple[Comparison, ...]:
    """Return the comparison of each pair; p-values are corrected for all pairs together."""
    tests = [signed_rank(*pair.case_errors()) for pair in pairs]
    corrected = holm([test.p for test in tests])
    return tuple(
        Comparison(pair, test, p, bootstrap.compare_paired(pair.errors_a, pair.errors_b, groups=pair.groups))
        for pair, test, p in zip(pairs, tests, corrected, strict=True)
    )


def verdict(comparison: Comparison) -> str:
    """Return a sentence that reports which method is better, and if the difference is significant."""
    matched, test = comparison.matched, comparison.test
    name_a, name_b = matched.names
    counts = (
        f"{name_a} has smaller errors than {name_b} on {test.wins} of {matched.cases}, larger on {test.losses}, equal "
        f"on {test.ties}"
    )
    if comparison.p_holm > 1 - LEVEL:
        return f"{counts}: not significant (Holm-corrected p = {comparison.p_holm:.2g})."
    better = name_a if test.effect < 0 else name_b
    return f"{counts}: {better} is better (Holm-corrected p = {comparison.p_holm:.2g}, effect {test.effect:+.2f})."


def tests_table(comparisons: Sequence[Comparison]) -> Table:
    """Return the signed-rank tests, one row for each comparison."""
    return Table(
        f"Paired {comparisons[0].matched.metric} errors",
        ("First", "Second", "p", "p (Holm)", "Effect", "Images", "Groups", "First better", "Second better", "Equal"),
        tuple(map(_test_row, comparisons)),
        notes=TEST_NOTES,
    )


def _test_row(comparison: Comparison) -> tuple[Cell, ...]:
    matched, test = comparison.matched, comparison.test
    counts = (*matched.sizes, test.wins, test.losses, test.ties)
    return (*matched.names, f"{test.p:.2g}", f"{comparison.p_holm:.2g}", test.effect, *counts)


def statistics_table(comparisons: Sequence[Comparison]) -> Table:
    """Return every statistic of the comparisons, with difference and ratio."""
    return Table(
        f"Statistics of {comparisons[0].matched.metric} errors, degrees",
        ("First", "Second", "Statistic", *_VALUE_HEADS),
        tuple(
            (*item.matched.names, _STATISTIC_HEADS[pair.statistic], pair.value_a, pair.value_b, *_interval_cells(pair))
            for item in comparisons
            for pair in item.statistics
        ),
        digits=3,
        notes=(
            f"Intervals of {LEVEL:.0%}: BCa bootstrap over images or groups of images, {bootstrap.RESAMPLES} "
            f"resamples, the same for both methods. A single group has no interval; worst 5% has "
            f"none with fewer than {bootstrap.TAIL_GROUPS} images or groups.",
        ),
    )


def images_table(comparison: Comparison, count: int = 10) -> Table:
    """Return the images with the largest differences, in descending order; equal errors are omitted."""
    matched = comparison.matched
    a, b = matched.errors_a.tolist(), matched.errors_b.tolist()
    differences = np.abs(matched.errors_a - matched.errors_b)
    order = np.argsort(-differences, kind="stable")[:count].tolist()
    largest = [index for index in order if differences[index] >= TIE_DEG]
    return Table(
        "{} against {}: the largest differences, degrees".format(*matched.names),
        ("Image", "First", "Second", "Difference"),
        tuple((matched.images[index], a[index], b[index], a[index] - b[index]) for index in largest),
    )


def error_scatter(matched: MatchedErrors, form: FigureForm = "page") -> bytes:
    """Return a figure: errors of the second method against errors of the first, with the line of equality."""

    def draw(figure: Any) -> None:
        x, y = np.maximum(matched.errors_a, _FLOOR_DEG), np.maximum(matched.errors_b, _FLOOR_DEG)
        ends = [min(x.min(), y.min()) / 1.15, max(x.max(), y.max()) * 1.15]
        axes = figure.add_subplot()
        axes.plot(ends, ends, color=FAINT, linewidth=1, zorder=1)
        for colour, is_drawn in ((SERIES[0], x <= y), (SERIES[1], x > y)):
            axes.scatter(x[is_drawn], y[is_drawn], s=14, color=colour, alpha=0.8, linewidths=0, zorder=2)
        labels = [f"{name}: error, degrees" for name in matched.names]
        axes.set(xscale="log", yscale="log", xlim=ends, ylim=ends, aspect="equal", xlabel=labels[0], ylabel=labels[1])
        axes.xaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_major_formatter("{x:g}")

    return draw_svg(draw, inches=(4.6, 4.4), form=form)


def comparison_page(comparisons: Sequence[Comparison], notes: Sequence[str]) -> str:
    """Return the HTML page of comparisons."""
    elements: list[Markup] = [*map(pages.paragraph, notes), table_part(tests_table(comparisons))]
    for comparison in comparisons:
        name_a, name_b = comparison.matched.names
        caption = f"One point for each image: above the line (blue) {name_a} is better, below it (orange) {name_b}."
        figure = pages.figure(error_scatter(comparison.matched), caption)
        details = [
            pages.paragraph(verdict(comparison)),
            _statistics_part(comparison),
            pages.row([figure, table_part(images_table(comparison))]),
        ]
        elements.append(pages.fold(f"{name_a} against {name_b}", details, is_open=len(comparisons) <= MAX_DETAILED))
    return pages.page(f"Comparison of {comparisons[0].matched.metric} errors", elements)


def _statistics_part(comparison: Comparison) -> Markup:
    def with_interval(values: tuple[float, float, float]) -> str:
        value, low, high = ("–" if np.isnan(number) else f"{number:.3f}" for number in values)
        return f"{value} ({low} – {high})"

    rows = [
        (
            _STATISTIC_HEADS[pair.statistic],
            f"{pair.value_a:.3f}",
            f"{pair.value_b:.3f}",
            *map(with_interval, (pair.difference, pair.ratio)),
        )
        for pair in comparison.statistics
    ]
    names = comparison.matched.names
    table = statistics_table([comparison])
    return pages.table(
        table.title, ("Statistic", *names, "Difference", "Ratio"), rows, (False, *[True] * 4), table.notes
    )


def _interval_cells(pair: PairedFigure) -> list[Cell]:
    # NaN means unknown. Infinite ratios are kept.
    return [None if np.isnan(number) else number for number in (*pair.difference, *pair.ratio)]


def write_comparisons(
    folder: Path, comparisons: Sequence[Comparison], notes: Sequence[str], figures: FigureForm | None = None
) -> None:
    """Write a new folder: `tests.csv`, `statistics.csv`, `tables.tex`, `report.html`, and figures if requested."""
    tables = {"tests.csv": tests_table(comparisons), "statistics.csv": statistics_table(comparisons)}
    texts = {name: table_to_csv(table) for name, table in tables.items()}
    texts["tables.tex"] = "\n".join(map(table_to_latex, tables.values()))
    texts["report.html"] = comparison_page(comparisons, notes)
    with atomic_folder(folder, "the comparison") as partial_folder:
        for name, text in texts.items():
            (partial_folder / name).write_text(text, encoding="utf-8")
        if figures is not None:
            for number, comparison in enumerate(comparisons, start=1):
                (partial_folder / f"scatter_{number}.{figures}").write_bytes(error_scatter(comparison.matched, figures))
