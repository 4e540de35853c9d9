"""A description's tables and page, alone or beside another's."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from markupsafe import Markup

from evaluation.experiments.describing.against import TOLERANCE, FigureCompared, compare_figures, sentence
from evaluation.experiments.describing.description import DataDescription, figures, known_values
from evaluation.experiments.describing.lights import energy_distance, light_distribution
from evaluation.experiments.describing.quantities import QUANTITIES
from evaluation.reports.description_figures import chroma_figure, lights_figure, luminance_figure, noise_figure
from evaluation.reports.page import table_part
from evaluation.results.tables import Table
from foundation import pages
from generator.statistics import CHROMA_EDGES, LUMINANCE_EDGES, log_chroma


def figures_table(description: DataDescription) -> Table:
    """Return the figures of a data set, with the quartiles of the images' numbers that they are made of."""
    value = figures(description)
    rows: list[tuple[str | float | None, ...]] = []
    for quantity in QUANTITIES:
        known = known_values(description, quantity.value)
        # A spread is of all images: quartiles would be of something else.
        one_each = known.size and quantity.summed != "spread"
        quartiles = np.percentile(known, [25, 75], method="hazen") if one_each else (np.nan, np.nan)
        numbers = (_known(float(number)) for number in (value[quantity.name], *quartiles))
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
        (
            made.name,
            found.count,
            *found.mean,
            found.along,
            found.across,
            found.axis_deg,
            found.hull_area,
        )
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
                *(_known(number) for number in made.change),
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
        quantity.title for quantity in QUANTITIES if _is_known(one, quantity.value) != _is_known(other, quantity.value)
    }
    if unknown:
        notes.append(f"Known of one of the two only, and left out: {', '.join(sorted(unknown))}.")
    return tuple(notes)


def describe_page(one: DataDescription, other: DataDescription | None = None, seed: int = 0) -> str:
    """Return the HTML page of a data set, or of one beside another."""
    both = (one,) if other is None else (one, other)
    names = [made.name for made in both]
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
    parts += [pages.heading("Luminance"), _luminance(both, names), pages.heading("Chroma"), _chroma(both, names)]
    parts += [pages.heading("Lights"), table_part(lights_table(both)), pages.row([_lights(both, names), *_noise(both)])]
    for made in both:
        parts += [pages.heading(made.name), table_part(figures_table(made)), table_part(sizes_table(made))]
        parts += [pages.paragraph(f"{what}: {told}") for what, told in made.treatment.items()]
    parts += [pages.heading("Definitions"), table_part(_definitions())]
    return pages.page(" beside ".join(names), parts)


def sizes_table(description: DataDescription, count: int = 6) -> Table:
    """Return the most frequent sizes of the images."""
    rest = sum(number for _, _, number in description.sizes[count:])
    rows = [(f"{width} x {height}", number) for width, height, number in description.sizes[:count]]
    if rest:
        rows.append((f"{len(description.sizes) - count} other sizes", rest))
    notes = [f"{description.mixed} images under several lights; {description.masked:.1%} of the pixels are masked."]
    return Table(f"{description.name}: sizes, px", ("Size", "Images"), tuple(rows), notes=tuple(notes))


def _definitions() -> Table:
    return Table(
        "What the figures are",
        ("Figure", "Definition"),
        tuple((quantity.title, quantity.definition) for quantity in QUANTITIES),
    )


def _luminance(both: Sequence[DataDescription], names: Sequence[str]) -> Markup:
    picture = luminance_figure(names, [made.luminance for made in both], LUMINANCE_EDGES)
    return pages.figure(
        picture,
        "Luminance of the cells: the mean of the channels with the light divided out, over its 99th percentile in the "
        "image. Every image counts the same.",
    )


def _chroma(both: Sequence[DataDescription], names: Sequence[str]) -> Markup:
    picture = chroma_figure(names, [made.chroma for made in both], CHROMA_EDGES)
    return pages.figure(
        picture,
        "Colours of the cells with the light divided out; grey is where the lines cross. The depth of colour grows "
        "with the share of cells to the power of 0.4, on one scale.",
    )


def _lights(both: Sequence[DataDescription], names: Sequence[str]) -> Markup:
    return pages.figure(lights_figure(names, [made.lights for made in both]), "The lights; of mixtures, each light.")


def _noise(both: Sequence[DataDescription]) -> list[Markup]:
    unit = both[0].noise_unit
    shown = [made for made in both if made.noise_unit == unit and made.noise[1].levels]
    if not shown:
        return []
    measured = [np.array([(level.signal, level.sigma) for level in made.noise[1].levels]) for made in shown]
    curves = [
        (curve.read, curve.gain) if curve.read is not None and curve.gain is not None else None
        for curve in (made.noise[1] for made in shown)
    ]
    caption = "Noise of green in the flattest tenth of blocks of 8 x 8 pixels, at full size; lines: fitted curves."
    return [pages.figure(noise_figure([made.name for made in shown], measured, curves, unit), caption)]


def _seen_at(description: DataDescription) -> str:
    return f"{description.side} x {description.side} cells at most" if description.side else "full size"


def _is_known(description: DataDescription, value: str) -> bool:
    return bool(known_values(description, value).size)


def _known(number: float) -> float | None:
    return number if np.isfinite(number) else None
