"""Figures of the experiment's design: the chromaticities of the lights, as in the paper's figure of them.

Matplotlib is imported where a figure is made, and through its objects only: no window, no state left behind.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiment.lights.illuminations import Illumination
from foundation.colorimetry import decode_srgb
from foundation.errors import InputError
from foundation.files import whole_file

FORMATS = ("png", "pdf", "svg")
"""Endings of a figure's file name, and Matplotlib's names of these formats."""

_NAMED_CCTS_K = (2000, 3000, 4000, 6000, 10000)
"""Temperatures that the figure names, kelvin: few enough for their names not to touch."""


def plot_illuminations(illuminations: Sequence[Illumination], path: Path) -> None:
    """Plot the rb-chromaticities of lights (paper, section 3.1), each point in the colour of its light.

    Chromaticities are those of the linear light that a projector with the sRGB transfer function sends out:
    r = R / (R + G + B) and b = B / (R + G + B) of the decoded codes. A light without any light is left out.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    ending = path.suffix.lower().removeprefix(".")
    if ending not in FORMATS:
        raise InputError(f"a figure cannot be written as {path.name}; end its name with .{', .'.join(FORMATS)}")
    lit = [light for light in illuminations if any(light.codes)]
    codes = np.array([light.codes for light in lit]).reshape(-1, 3) / 255
    linear = decode_srgb(codes)
    r, _, b = (linear / linear.sum(axis=1, keepdims=True)).T
    black_body = np.array([light.kind == "blackbody" for light in lit], dtype=np.bool_)

    # Matplotlib's own types leave the keyword arguments of every method unknown.
    figure: Any = Figure(figsize=(7.2, 6.8), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.plot([0, 1, 0, 0], [0, 0, 1, 0], color="0.75", linewidth=0.8, zorder=1)
    axes.scatter(
        r[~black_body],
        b[~black_body],
        s=22,
        c=codes[~black_body],
        edgecolors="0.55",
        linewidths=0.3,
        zorder=2,
        label=f"uniform ({int((~black_body).sum())})",
    )
    axes.scatter(
        r[black_body],
        b[black_body],
        s=34,
        c=codes[black_body],
        marker="D",
        edgecolors="black",
        linewidths=0.9,
        zorder=3,
        label=f"black bodies ({int(black_body.sum())})",
    )
    for light, x, y in zip(lit, r, b, strict=True):
        if light.cct_k in _NAMED_CCTS_K:
            # Named outside the triangle, so that no light is hidden.
            away = (1.04 - float(x) - float(y)) / 2
            axes.annotate(
                f"{light.cct_k:g} K",
                (float(x), float(y)),
                xytext=(float(x) + away, float(y) + away),
                fontsize=9,
                arrowprops={"arrowstyle": "-", "color": "0.3", "linewidth": 0.7, "shrinkA": 0, "shrinkB": 4},
                zorder=4,
            )
    axes.set_xlabel("r")
    axes.set_ylabel("b")
    axes.set_xlim(-0.03, 1.03)
    axes.set_ylim(-0.03, 1.03)
    axes.set_aspect("equal")
    axes.legend(loc="upper right", frameon=False)
    axes.set_title(f"rb-chromaticities of {len(lit)} illuminations")
    # The day of writing is kept out of the file, so that the same lights give the same PNG.
    metadata = {"png": {"Software": None}, "pdf": {"CreationDate": None}, "svg": {"Date": None}}[ending]
    with whole_file(path) as stream:
        figure.savefig(stream, format=ending, dpi=150, metadata=metadata)
