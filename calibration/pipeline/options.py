"""What a user may choose about how a table is built; part of an unfinished table's identity."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

from calibration.sampling.samples import WINDOW
from calibration.sampling.windows import WINDOWS
from experiment.config import CitationSettings
from experiment.framing.field import Corners
from foundation.errors import InputError


@dataclass(frozen=True)
class BuildOptions:
    """How a table is built; by default 25 samples, the paper's, from which black and the lens's spread are subtracted.

    - `window`: pixels along the side of a cell's window: one of `calibration.sampling.windows.WINDOWS`.
    - `subtract_dark`: whether the light of the dark frames is subtracted from samples and ground truth.
    - `corners`: four corners (x, y) of the field of cells in the frame that is registered first, half-size px,
      clockwise from the printed top-left, for a chart without tags; None to have it found.
    - `correct_drift`: whether the lamp's drift between white frames is taken out of samples and ground truth at the
      end.
    - `lens_correction`: whether what the lens spreads beside its sharp core is subtracted from samples and ground
      truth, where the print proves that it does.
    - `citation`: what the lab states of the table's origin; None for what the session's settings state. No sample
      depends on it.
    """

    window: int = WINDOW
    subtract_dark: bool = False
    corners: Corners | None = None
    correct_drift: bool = False
    lens_correction: bool = True
    citation: CitationSettings | None = None

    def __post_init__(self) -> None:
        if self.window not in WINDOWS:
            raise InputError(
                f"a window of {self.window} pixels was asked for; {', '.join(map(str, WINDOWS[:-1]))} or {WINDOWS[-1]} "
                "expected: a window has a middle pixel, and cells are about 10 pixels wide"
            )

    @property
    def samples(self) -> int:
        """Samples of each cell."""
        return self.window**2

    def to_json(self) -> dict[str, Any]:
        """Return the options as JSON can hold them, but for the citation: they are part of what samples depend on."""
        values = asdict(replace(self, citation=None))
        del values["citation"]
        return values | {"corners": None if self.corners is None else [list(corner) for corner in self.corners]}


PAPER_OPTIONS = BuildOptions()
"""The paper's options, which hold where none are given."""
