"""The numbers by which a table is judged, as far as more than its verdict uses them; each stands here and nowhere else.

`calibration.verdict.thresholds` judges a table by them and says why; `acquire check` foretells that verdict
(`acquisition.check.findings`), and the live judge keeps to them where it follows a lasting change
(`acquisition.judge.limits`). So no two of the three disagree about a frame by having other numbers.

Where one of the two that come before the table is stricter, it is a warning while something can still be mended, and
docs/how-to/check.md says of each why.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

from experiment.framing.finding import MIN_TAG_SHARE
from experiment.framing.planes import CLIPPING_SHARE, MIN_SIGNAL
from experiment.framing.visibility import MIN_CELL_PX

Sense = Literal["at most", "at least"]
TableOutcome = Literal["accept", "accept with remarks", "refuse"]
"""What a figure does to a table."""


@dataclass(frozen=True)
class TableLimit:
    """The limits of one figure of a table.

    - `unit`: of both limits; "" for a count or a plain number, "share" for 0 … 1.
    - `sense`: on which side of the limits a value is accepted.
    - `accept`: up to here nothing is remarked.
    - `refuse`: beyond it no table is made; None where the value is only ever remarked on.
    """

    unit: str
    sense: Sense
    accept: float
    refuse: float | None

    def outcome(self, value: float) -> TableOutcome:
        """Return what a value does to a table; one that is not a number is as bad as can be."""
        sign = 1 if self.sense == "at most" else -1
        if self.refuse is not None and not sign * value <= sign * self.refuse:
            return "refuse"
        return "accept" if sign * value <= sign * self.accept else "accept with remarks"

    @property
    def ranges(self) -> tuple[tuple[float | None, float | None], tuple[float | None, float | None]]:
        """Lowest and highest value that is accepted, and that is not refused; None where open."""
        if self.sense == "at most":
            return (None, self.accept), (None, self.refuse)
        return (self.accept, None), (self.refuse, None)

    @property
    def numbers(self) -> tuple[str, Sense, float, float | None]:
        """Unit, sense and both limits, as `calibration.figures.figure.Threshold` takes them."""
        return self.unit, self.sense, self.accept, self.refuse


TABLE_LIMITS: Mapping[str, TableLimit] = MappingProxyType(
    {
        "tags_found": TableLimit("share", "at least", 1.0, MIN_TAG_SHARE),
        "cell_px": TableLimit("px", "at least", 8.6, MIN_CELL_PX),
        "bleed": TableLimit("share", "at most", 0.005, 0.03),
        "unfit_share": TableLimit("share", "at most", 0.005, 0.1),
        "doubtful_share": TableLimit("share", "at most", 0.0003, None),
        "added_light": TableLimit("share", "at most", 0.004, 0.01),
        "references_used": TableLimit("share", "at least", 0.9, 0.3),
        "reference_spread": TableLimit("share", "at most", 0.01, 0.05),
        "leak_share": TableLimit("share", "at most", 0.005, 0.1),
        "dark_drift": TableLimit("share", "at most", 0.002, 0.05),
        "white_drift": TableLimit("share", "at most", 0.01, 0.15),
        "white_drift_deg": TableLimit("°", "at most", 0.2, 2.0),
        "linearity": TableLimit("share", "at most", 0.01, 0.05),
        "additivity": TableLimit("share", "at most", 0.02, None),
        "off_codes_deg": TableLimit("°", "at most", 2.0, 8.0),
        "grey_tint_deg": TableLimit("°", "at most", 6.0, None),
        "brightest_share": TableLimit("share", "at most", 0.9, CLIPPING_SHARE),
        "darkest_counts": TableLimit("counts", "at least", 300.0, MIN_SIGNAL),
    }
)
"""By the names of the figures, as in `report.json`. What each number rests on stands with its threshold."""

ONLY_OF_A_SESSION: tuple[str, ...] = (
    # Of the registration, which is finer than what a check takes the time for.
    "tag_residual_px", "tag_final_px", "block_residual_px", "blocks_good", "agreement",
    # Of frames against each other.
    "softer_bleed", "unlike_scatter", "unlike_block", "disturbed_cells", "moved_anew", "black_drift_counts",
    "drift_left",
    "other_camera", "other_lens", "other_exposure", "other_iso", "white_frames",
    # Of the lights.
    "truth_median_deg", "truth_worst_deg", "off_brightness", "white_short", "exchanged_lights", "exchange_deg",
    "held_share", "white_frame_deg", "white_frame_brightness", "primaries_lacking", "stray_share", "code_misfit",
    # Of the lens, which is measured on the frames of the primaries.
    "correction_residual", "correction_worst",
    # Of the noise of the cells.
    "noise_misfit", "noisy_share",
)  # fmt: skip
"""Figures of a table that a check cannot know, by their names in `report.json`; all others are in `TABLE_LIMITS`."""
