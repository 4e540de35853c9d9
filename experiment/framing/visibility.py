"""How large a chart's parts are in a camera's frames, and the warning when they are too small.

A chart fills its share of the frame whatever its size in millimetres, so what counts is how many cells stand side by
side: a small sheet is photographed from nearer. Half-size pixels. Knows sizes of frames, nothing of lenses or prints.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from experiment.chart.model import TAG_MODULES, Chart
from experiment.framing.tags import MIN_MODULE_PX

MIN_CELL_PX = 8.0
"""Half-size pixels a cell must have for 25 of them to lie safely inside: 5, rounding and registration, and the blur.
8.6 already bleeds 1 % at σ = 0.7."""

HALF_SIZE_PX = {"EOS 550D": (2601, 1732), "EOS 6D Mark II": (3132, 2090)}
"""Width and height of the paper's cameras' half-size images (section 3.3 names them)."""

FILL = 0.94
"""Share of the frame that a sheet fills along its tighter axis."""


@dataclass(frozen=True)
class ApparentSize:
    """What a camera sees of a chart: pixels of a cell's shorter side and of a tag's module (None without tags)."""

    camera: str
    cell_px: float
    module_px: float | None

    @property
    def enough(self) -> bool:
        """Whether 25 pixels of a cell can be sampled and tags be found."""
        return self.cell_px >= MIN_CELL_PX and (self.module_px is None or self.module_px >= MIN_MODULE_PX)

    def __str__(self) -> str:
        """Return "EOS 550D: 6.1 px a cell, 2.4 px a tag module"."""
        module = "" if self.module_px is None else f", {self.module_px:.1f} px a tag module"
        return f"{self.camera}: {self.cell_px:.1f} px a cell{module}"


def apparent_sizes(chart: Chart) -> list[ApparentSize]:
    """Return what each of the paper's cameras sees of a chart that fills 94 % of its frame, turned as it fits best."""
    module_mm = min((float(np.ptp(tag.corners_mm[:, 0])) / TAG_MODULES for tag in chart.tags), default=None)
    page = sorted(chart.page_mm)
    seen: list[ApparentSize] = []
    for camera, frame in HALF_SIZE_PX.items():
        px_per_mm = FILL * min(pixels / side for pixels, side in zip(sorted(frame), page, strict=True))
        seen.append(ApparentSize(camera, min(chart.cell_mm) * px_per_mm, module_mm and module_mm * px_per_mm))
    return seen


def small_parts_warning(chart: Chart) -> str | None:
    """Return a sentence when a camera cannot separate the chart's cells or read its tags, else None."""
    seen = apparent_sizes(chart)
    if all(size.enough for size in seen):
        return None
    least = "" if seen[0].module_px is None else f" and {MIN_MODULE_PX:g} px a tag module"
    return (
        f"cells of {min(chart.cell_mm):.2f} mm are small for a camera: at {FILL:.0%} of the frame (half-size) "
        f"{'; '.join(map(str, seen))}; {MIN_CELL_PX:g} px a cell{least} are needed: fewer bits, larger cells, or a "
        "page nearer to 3 : 2"
    )
