"""The figures by which a data set is described, each with its definition.

All but noise, exposure and clipping are of images reduced to at most 64 x 64 cells with the light divided out
(`cells`); luminance is there the mean of the three channels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

from generator.statistics import GREY_DEG, LUMINANCE_PERCENTS

Summed = Literal["median", "mean", "spread"]
"""How numbers of images become one of the set; the spread is their standard deviation."""


@dataclass(frozen=True)
class Quantity:
    """A figure of a data set.

    - `name`: in files: `chroma_spread`.
    - `value`: the number of an image that it is made of; several quantities may be of one.
    - `title`: in tables: "Chroma spread".
    - `definition`: what it is, in one sentence.
    - `summed`: how it is made of the images' numbers.
    - `signed`: whether it has a sign or its zero is a place like any other, so that two sets are told apart by their
      difference and not by their ratio.
    """

    name: str
    value: str
    title: str
    definition: str
    summed: Summed = "median"
    signed: bool = False


QUANTITIES: Final[tuple[Quantity, ...]] = (
    *(
        Quantity(
            f"luminance_{percent}",
            f"luminance_{percent}",
            f"Luminance, {percent}{'st' if percent == 1 else 'th'} percentile",
            f"The {percent}{'st' if percent == 1 else 'th'} percentile of a cell's luminance over the 99th.",
        )
        for percent in LUMINANCE_PERCENTS
    ),
    Quantity(
        "exposure",
        "exposure",
        "Exposure",
        "The 99th percentile of a pixel's largest channel over saturation, before the light is divided out.",
    ),
    Quantity("clipped", "clipped", "Clipped share", "Share of the unmasked pixels that are clipped.", "mean"),
    Quantity(
        "chroma_spread",
        "chroma_spread",
        "Chroma spread",
        "Root mean square of the standard deviations of r, g and b (each channel over their sum) of an image's cells.",
    ),
    Quantity("log_red_spread", "log_red_spread", "Spread of ln(R/G)", "Standard deviation of ln(R/G) in an image."),
    Quantity("log_blue_spread", "log_blue_spread", "Spread of ln(B/G)", "Standard deviation of ln(B/G) in an image."),
    Quantity(
        "near_grey", "near_grey", "Near-grey share", f"Share of cells within {GREY_DEG:g} degrees of white.", "mean"
    ),
    Quantity(
        "grey_offset_red",
        "grey_red",
        "Grey-world offset, red",
        "ln(R/G) of an image's mean: where grey lies.",
        "mean",
        True,
    ),
    Quantity(
        "grey_offset_blue",
        "grey_blue",
        "Grey-world offset, blue",
        "ln(B/G) of an image's mean: where grey lies.",
        "mean",
        True,
    ),
    Quantity(
        "grey_spread_red",
        "grey_red",
        "Grey-world spread, red",
        "Standard deviation over the images of ln(R/G) of their means.",
        "spread",
    ),
    Quantity(
        "grey_spread_blue",
        "grey_blue",
        "Grey-world spread, blue",
        "Standard deviation over the images of ln(B/G) of their means.",
        "spread",
    ),
    Quantity(
        "edges", "edges", "Mean edge", "Mean of |difference of ln luminance| between neighbouring cells of an image."
    ),
    Quantity("edges_95", "edges_95", "Strong edges", "95th percentile of the same differences of an image."),
    Quantity(
        "noise",
        "noise",
        "Noise over signal",
        "Noise of green over its signal in the flattest tenth of the blocks of 8 x 8 pixels, at full size.",
    ),
    Quantity("light_red", "light_red", "Light, red", "Mean of ln(R/G) of the lights.", "mean", True),
    Quantity("light_blue", "light_blue", "Light, blue", "Mean of ln(B/G) of the lights.", "mean", True),
    Quantity(
        "light_spread_red",
        "light_red",
        "Spread of lights, red",
        "Standard deviation of ln(R/G) of the lights.",
        "spread",
    ),
    Quantity(
        "light_spread_blue",
        "light_blue",
        "Spread of lights, blue",
        "Standard deviation of ln(B/G) of the lights.",
        "spread",
    ),
)
"""All of them, in the order of the tables."""
