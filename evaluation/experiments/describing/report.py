"""A description's tables and page, alone or beside another's: how real is what was generated.

Images of the two have nothing to do with each other: each set is resampled by itself (`bootstrap.independent`). Two
figures are called alike where the one lies within a quarter of the other: a ratio of 1/1.25 … 1.25, or, for figures
with a sign, a difference within a quarter of the other's spread over its images. The quarter is a convention. Real
photographs of two cameras by one group (Canon 600D and 1Ds Mark III of NUS) are alike by it in 18 of 21 figures.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
import numpy.typing as npt
from markupsafe import Markup

from evaluation.experiments.bootstrap import independent
from evaluation.experiments.describing.description import (
    QUANTITIES,
    DataDescription,
    Quantity,
    energy_distance,
    figures,
    known_values,
    light_distribution,
    summed,
)
from evaluation.reports.table_output import table_part
from evaluation.results.tables import Table, finite_or_none
from foundation import pages
from foundation.plots import FAINT, GRID, SERIES, legend_label, svg_of
from generator.statistics import CHROMA_EDGES, LUMINANCE_EDGES, log_chroma

TOLERANCE: Final = 0.25
"""Share by which figures may differ and still be called alike: a convention."""

_SIZES: Final = 6
"""Sizes of images that are listed, the most frequent ones."""

_LEAST: Final = 3
"""Images of which a figure must be known in each set: a quartile needs them."""

Verdict = Literal["yes", "yes?", "no?", "no"]
"""Whether a figure is within the tolerance; with a question mark where its interval reaches over the border."""


@dataclass(frozen=True)
class FigureCompared:
    """A figure of a data set beside that of another.

    - `change`: one / other, or one - other of a figure with a sign, and its interval of 95 %; NaN where `other` is 0.
    - `scale`: what a difference is measured by: the other's spread over its images; 1 for a ratio.
    - `distance`, `p`: two-sample Kolmogorov-Smirnov statistic of the images' numbers, 0 … 1, and the probability of
      such a one where both sets are of one kind.
    - `verdict`: whether the change is within `TOLERANCE`; None where it is not known.
    """

    quantity: Quantity
    one: float
    other: float
    change: tuple[float, float, float]
    scale: float
    distance: float
    p: float
    verdict: Verdict | None


def compare_figures(one: DataDescription, other: DataDescription, seed: int = 0) -> tuple[FigureCompared, ...]:
    """Return every figure that is known of both sets, of at least three images each."""
    from scipy.stats import ks_2samp

    compared: list[FigureCompared] = []
    for quantity in QUANTITIES:
        first, second = (known_values(described, quantity.value) for described in (one, other))
        if min(len(first), len(second)) < _LEAST:
            continue
        values = summed(first, quantity.summed), summed(second, quantity.summed)
        scale = float(second.std()) if quantity.signed else 1.0
        change = _change(quantity, first, second, seed)
        test = ks_2samp(first, second)
        distance, p = float(test.statistic), float(test.pvalue)
        compared.append(
            FigureCompared(quantity, *values, change, scale, distance, p, _verdict(quantity, change, scale))
        )
    return tuple(compared)


def _change(
    quantity: Quantity, one: npt.NDArray[np.float64], other: npt.NDArray[np.float64], seed: int
) -> tuple[float, float, float]:
    if quantity.summed == "spread":
        # Deviations from the mean of the images themselves: the mean's own error is of second order.
        squares = [np.square(values - values.mean()) for values in (one, other)]
        ratio = independent(squares[0], squares[1], seed)[0].ratio
        return ratio[0] ** 0.5, ratio[1] ** 0.5, ratio[2] ** 0.5
    found = {compared.statistic: compared for compared in independent(one, other, seed)}[quantity.summed]
    return found.difference if quantity.signed else found.ratio


def _verdict(quantity: Quantity, change: tuple[float, float, float], scale: float) -> Verdict | None:
    if not np.isfinite(change[0]):
        return None
    low, high = (-TOLERANCE * scale, TOLERANCE * scale) if quantity.signed else (1 / (1 + TOLERANCE), 1 + TOLERANCE)
    within = low <= change[0] <= high
    sure = low <= change[1] and change[2] <= high if within else change[2] < low or change[1] > high
    return ("yes" if sure else "yes?") if within else ("no" if sure else "no?")


def sentence(compared: FigureCompared, names: tuple[str, str]) -> str:
    """Return in one sentence whether a figure of the one is what it is in the other."""
    quantity, (value, low, high) = compared.quantity, compared.change
    head = f"{quantity.title}: {compared.one:.3g} in {names[0]}, {compared.other:.3g} in {names[1]}"
    if quantity.signed:
        told = f"{value:+.3f} apart ({low:+.3f} to {high:+.3f}), {abs(value) / compared.scale:.0%} of its spread there"
        told = told if compared.scale > 0 else f"{value:+.3f} apart ({low:+.3f} to {high:+.3f})"
    else:
        told = f"{value:.2f} times as much ({low:.2f} to {high:.2f})"
    match compared.verdict:
        case None:
            return f"{head}: no ratio to a figure that is 0."
        case "yes":
            return f"{head}: {told}, within {TOLERANCE:.0%}."
        case "yes?":
            return f"{head}: {told}, within {TOLERANCE:.0%}, but other images might not be."
        case "no?":
            return f"{head}: {told}, not within {TOLERANCE:.0%}, but other images might be."
        case "no":
            return f"{head}: {told}, not within {TOLERANCE:.0%}."


_FAINTEST: Final = 0.4
"""Power of a share of cells at which it is drawn: rare colours stay visible beside frequent greys."""

_POINTS: Final = 3000
"""Lights drawn of a set at most: more make no other cloud, and a page too large to mail."""


def _luminance(both: Sequence[DataDescription]) -> Markup:
    """Return the figure of the distribution of luminance."""

    def draw(figure: Any) -> None:
        axes = figure.add_subplot()
        for made, colour in zip(both, SERIES, strict=False):
            # The first bin holds all that is darker.
            edges = np.power(10.0, LUMINANCE_EDGES)
            axes.stairs(100 * made.luminance, edges, label=legend_label(made.name), color=colour, linewidth=1.5)
        axes.set(xscale="log", xlabel="luminance over its 99th percentile in the image", ylabel="cells, %")
        axes.xaxis.set_major_formatter("{x:g}")
        axes.set_ylim(bottom=0)
        axes.legend(loc="upper left")

    return pages.figure(
        svg_of(draw, inches=(7.2, 3.2)),
        "Luminance of the cells: the mean of the channels with the light divided out, over its 99th percentile in the "
        "image. Every image counts the same.",
    )


def _chroma(both: Sequence[DataDescription]) -> Markup:
    """Return the figure of the histograms of chroma in the plane of ln(R/G) and ln(B/G), side by side."""

    def draw(figure: Any) -> None:
        from matplotlib.colors import LinearSegmentedColormap, to_rgba

        top = max(float(made.chroma.max()) for made in both) ** _FAINTEST
        low, high = CHROMA_EDGES[0], CHROMA_EDGES[-1]
        for number, made in enumerate(both):
            axes = figure.add_subplot(1, len(both), number + 1)
            clear, full = (to_rgba(SERIES[number], alpha) for alpha in (0, 1))
            axes.imshow(
                made.chroma.T**_FAINTEST,
                origin="lower",
                extent=(low, high, low, high),
                cmap=LinearSegmentedColormap.from_list(f"set{number}", [clear, full]),
                vmin=0,
                vmax=top,
                interpolation="nearest",
            )
            axes.axhline(0, color=FAINT, linewidth=0.6)
            axes.axvline(0, color=FAINT, linewidth=0.6)
            axes.set(title=made.name, xlabel="ln(R/G)", ylabel="ln(B/G)")

    return pages.figure(
        svg_of(draw, inches=(3.8 * len(both), 3.8)),
        "Colours of the cells with the light divided out; grey is where the lines cross. The depth of colour grows "
        "with the share of cells to the power of 0.4, on one scale.",
    )


def _lights(both: Sequence[DataDescription]) -> Markup:
    """Return the figure of the lights in the plane of the chromaticities r and b."""

    def draw(figure: Any) -> None:
        axes = figure.add_subplot()
        for made, colour in zip(both, SERIES, strict=False):
            some = made.lights[:: -(-len(made.lights) // _POINTS)]
            label = legend_label(made.name)
            axes.scatter(some[:, 0], some[:, 2], s=9, alpha=0.5, linewidths=0, color=colour, label=label)
        axes.set(xlabel="r = R / (R + G + B)", ylabel="b = B / (R + G + B)", aspect="equal")
        axes.legend(loc="upper right")

    return pages.figure(svg_of(draw, inches=(5.4, 4.6)), "The lights; of mixtures, each light.")


def _noise(both: Sequence[DataDescription]) -> list[Markup]:
    """Return the figure of noise of green against signal, with the fitted curves; nothing where none was measured."""
    unit = both[0].noise_unit
    shown = [made for made in both if made.noise_unit == unit and made.noise[1].levels]
    if not shown:
        return []

    def draw(figure: Any) -> None:
        axes = figure.add_subplot()
        for made, colour in zip(shown, SERIES, strict=False):
            curve = made.noise[1]
            levels = np.array([(level.signal, level.sigma) for level in curve.levels])
            axes.plot(levels[:, 0], levels[:, 1], "o", markersize=4, color=colour, label=legend_label(made.name))
            if curve.read is not None and curve.gain is not None:
                signal = np.exp(np.linspace(np.log(levels[0, 0]), np.log(levels[-1, 0]), 100, dtype=np.float64))
                axes.plot(signal, np.sqrt(curve.read**2 + curve.gain * signal), color=colour, linewidth=1)
        axes.set(xscale="log", yscale="log", xlabel=f"signal, {unit} = 1", ylabel="standard deviation")
        axes.grid(visible=True, which="major", color=GRID)
        axes.legend(loc="upper left")

    caption = "Noise of green in the flattest tenth of blocks of 8 x 8 pixels, at full size; lines: fitted curves."
    return [pages.figure(svg_of(draw, inches=(5.4, 4.0)), caption)]


def figures_table(description: DataDescription) -> Table:
    """Return the figures of a data set, with the quartiles of the images' numbers that they are made of."""
    value = figures(description)
    rows: list[tuple[str | float | None, ...]] = []
    for quantity in QUANTITIES:
        known = known_values(description, quantity.value)
        # A spread is of all images: quartiles would be of something else.
        one_each = known.size and quantity.summed != "spread"
        quartiles = np.percentile(known, [25, 75], method="hazen") if one_each else (np.nan, np.nan)
        numbers = (finite_or_none(float(number)) for number in (value[quantity.name], *quartiles))
        rows.append((quantity.title, quantity.summed, *numbers, known.size))
    return Table(
        f"{description.name}: figures of {len(description.images)} images",
        ("Figure", "Of the images", "Value", "25 %", "75 %", "Images"),
        tuple(rows),
        digits=4,
        notes=(
            f"Scenes are seen at {_seen_at(description)}, with the light divided out. 25 % and 75 %: quartiles of the "
            "images' numbers.",
            *noise_notes(description),
        ),
    )


def lights_table(descriptions: Sequence[DataDescription]) -> Table:
    """Return the distributions of the lights of one or two data sets."""
    rows = [
        (made.name, found.count, *found.mean, found.along, found.across, found.axis_deg, found.hull_area)
        for made in descriptions
        for found in [light_distribution(made.lights)]
    ]
    notes = ["In the plane of ln(R/G) and ln(B/G): standard deviations along and across the principal axis."]
    if len(descriptions) == 2:
        share, p = energy_distance(log_chroma(descriptions[0].lights), log_chroma(descriptions[1].lights))
        notes.append(
            f"Energy distance of the two distributions {share:.3f} of its largest (0 where they are equal), "
            f"permutation test p = {p:.3f}."
        )
    heads = ("Lights of", "Lights", "Mean ln(R/G)", "Mean ln(B/G)", "Along", "Across", "Axis, degrees", "Hull area")
    return Table("Distribution of the lights", heads, tuple(rows), digits=3, notes=tuple(notes))


def compared_tables(compared: Sequence[FigureCompared], names: tuple[str, str]) -> list[Table]:
    """Return the figures of two sets side by side: those with a ratio, and those with a difference."""
    tables: list[Table] = []
    for signed, change, note in (
        (False, "Ratio", f"Within {TOLERANCE:.0%}: a ratio of {1 / (1 + TOLERANCE):g} to {1 + TOLERANCE:g}."),
        (True, "Difference", f"Within {TOLERANCE:.0%} of the second's spread over its images."),
    ):
        rows = tuple(
            (
                made.quantity.title,
                made.verdict,
                made.one,
                made.other,
                *map(finite_or_none, made.change),
                made.distance,
                made.p,
            )
            for made in compared
            if made.quantity.signed == signed
        )
        notes = (
            f"{note} A question mark: the interval reaches over that border. Intervals of 95 %, BCa bootstrap over the "
            "images of each set. KS: Kolmogorov-Smirnov distance of the images' numbers; p of 0.000 is below .0005.",
        )
        heads = ("Figure", f"Within {TOLERANCE:.0%}", *names, change, "from", "to", "KS", "p")
        if rows:
            tables.append(Table(f"{names[0]} beside {names[1]}", heads, rows, digits=3, notes=notes))
    return tables


def noise_notes(description: DataDescription) -> tuple[str, ...]:
    """Return what is to be said of the noise of a data set."""
    green = description.noise[1]
    if green.gain is not None and green.read is not None:
        curve = f"variance = {green.read:.2g}² + {green.gain:.2g} · signal"
        told = f"Noise of green follows {curve}, {description.noise_unit} = 1."
    elif green.misfit is not None:
        told = "Noise follows no photon-transfer curve: what the flattest blocks show is texture, or was processed."
    else:
        told = "Flat blocks at too few levels for a photon-transfer curve."
    averaged = description.layout == "thumbnails"
    return (told, *(("Noise of thumbnails is what averaging left, and their texture.",) if averaged else ()))


def seen_notes(one: DataDescription, other: DataDescription) -> tuple[str, ...]:
    """Return what makes two descriptions less comparable than they look."""
    notes: list[str] = []
    if one.side != other.side:
        notes.append(
            f"{one.name} was seen at {_seen_at(one)}, {other.name} at {_seen_at(other)}: their scenes do not compare; "
            "describe both alike (--cells)."
        )
    notes += [
        f"Images of {made.name} have fewer than {made.side} pixels a side: their cells are pixels, noise included."
        for made in (one, other)
        if any(min(width, height) < made.side for width, height, _ in made.sizes)
    ]
    notes += [
        f"The {len(made.images)} images of {made.name} are of {made.groups} pictures or places; they count as "
        "independent, and intervals are too narrow."
        for made in (one, other)
        if made.groups is not None and made.groups < len(made.images)
    ]
    unknown = {
        quantity.title
        for quantity in QUANTITIES
        if len({known_values(made, quantity.value).size > 0 for made in (one, other)}) > 1
    }
    if unknown:
        notes.append(f"Known of one of the two only, and left out: {', '.join(sorted(unknown))}.")
    return tuple(notes)


def describe_page(one: DataDescription, other: DataDescription | None = None, seed: int = 0) -> str:
    """Return the HTML page of a data set, or of one beside another."""
    both = (one,) if other is None else (one, other)
    parts: list[Markup] = []
    if other is not None:
        pair = (one.name, other.name)
        compared = compare_figures(one, other, seed)
        alike = sum(made.verdict in ("yes", "yes?") for made in compared)
        parts.append(
            pages.paragraph(
                f"{alike} of {len(compared)} figures of {one.name} are within {TOLERANCE:.0%} of {other.name}'s."
            )
        )
        parts += [pages.paragraph(note) for note in seen_notes(one, other)]
        parts += [table_part(table) for table in compared_tables(compared, pair)]
        parts.append(pages.heading("Figure by figure"))
        parts += [pages.paragraph(sentence(made, pair)) for made in compared]
    parts += [pages.heading("Luminance"), _luminance(both), pages.heading("Chroma"), _chroma(both)]
    parts += [pages.heading("Lights"), table_part(lights_table(both)), pages.row([_lights(both), *_noise(both)])]
    for made in both:
        parts += [pages.heading(made.name), table_part(figures_table(made)), table_part(sizes_table(made))]
        parts += [pages.paragraph(f"{what}: {told}") for what, told in made.treatment.items()]
    definitions = tuple((quantity.title, quantity.definition) for quantity in QUANTITIES)
    parts.append(pages.heading("Definitions"))
    parts.append(table_part(Table("What the figures are", ("Figure", "Definition"), definitions)))
    return pages.page(" beside ".join(made.name for made in both), parts)


def sizes_table(description: DataDescription) -> Table:
    """Return the most frequent sizes of the images."""
    rest = sum(number for _, _, number in description.sizes[_SIZES:])
    rows = [(f"{width} x {height}", number) for width, height, number in description.sizes[:_SIZES]]
    if rest:
        rows.append((f"{len(description.sizes) - _SIZES} other sizes", rest))
    notes = [f"{description.mixed} images under several lights; {description.masked:.1%} of the pixels are masked."]
    return Table(f"{description.name}: sizes, px", ("Size", "Images"), tuple(rows), notes=tuple(notes))


def _seen_at(description: DataDescription) -> str:
    return f"{description.side} x {description.side} cells at most" if description.side else "full size"
