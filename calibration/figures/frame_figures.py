"""The figures of one frame, and their form in a checkpoint."""

from __future__ import annotations

from dataclasses import asdict, astuple, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from calibration.checks.frame_consistency import FrameConsistency
from drivers.raw.rawfile import FrameOrigin
from experiment.framing.movement import Shift
from experiment.framing.planes import Channel
from experiment.measures.paper import FieldResidual, FlatField, Paper
from experiment.session.records import FrameRecord

_Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class FrameFigures:
    """What was measured on one light or white frame.

    - `black`: (2, 2) float64 counts, black level of each position of the Bayer block.
    - `channel`: the channel in which the chart's movement was measured.
    - `shift`: movement against the frame that was registered last.
    - `reregistered`: whether the chart had moved so far that it was registered again in this frame.
    - `paper`: flat field and white of bare paper.
    - `consistency`: how much the frame differs from the print as it was first registered.
    - `greys`, `grey_errors`: (G, 3) float64 counts above black of each level of grey, field divided out, and their
      standard errors.
    - `dark`: (3,) float64 counts, dark light of bare paper that was subtracted; zeros where none was.
    - `share_at_zero`: share, 0 … 1, of the frame's samples in the table that are 0.
    - `blur_px`: σ of the frame's blur, half-size px: that of the frame registered last, plus the change since.
    - `exposure`: shutter time × ISO speed / f-number² by the raw file, s; 0 where it does not state them.
    - `origin`: camera, lens and exposure as the raw file states them.
    """

    record: FrameRecord
    black: _Array
    channel: Channel
    shift: Shift
    reregistered: bool
    paper: Paper
    consistency: FrameConsistency
    greys: _Array
    grey_errors: _Array
    dark: _Array
    share_at_zero: float
    blur_px: float
    exposure: float
    origin: FrameOrigin

    def to_json(self) -> dict[str, Any]:
        """Return the figures, but for the record, as JSON can hold them; `from_json` restores them to the last bit."""
        return {
            "black": self.black.tolist(),
            "channel": self.channel,
            "shift": list(astuple(self.shift)),
            "reregistered": self.reregistered,
            "field": [[factor.tolist() for factor in factors] for factors in self.paper.field.coefficients],
            "white": self.paper.white.tolist(),
            "error": self.paper.error.tolist(),
            "references": self.paper.references,
            "spread": self.paper.spread.tolist(),
            "left": self.paper.left.to_json(),
            "consistency": self.consistency.to_json(),
            "greys": self.greys.tolist(),
            "grey_errors": self.grey_errors.tolist(),
            "dark": self.dark.tolist(),
            "share_at_zero": self.share_at_zero,
            "blur_px": self.blur_px,
            "exposure": self.exposure,
            "origin": asdict(self.origin),
        }

    @staticmethod
    def from_json(record: FrameRecord, page_mm: tuple[float, float], stored: dict[str, Any]) -> FrameFigures:
        """Return the figures of a frame from what `to_json` returned; `page_mm` is the chart's width and height."""
        red, green, blue = (tuple(np.array(factor) for factor in factors) for factors in stored["field"])
        white, error, spread = (np.array(stored[name]) for name in ("white", "error", "spread"))
        return FrameFigures(
            record=record,
            black=np.array(stored["black"]),
            channel=stored["channel"],
            shift=Shift(*stored["shift"]),
            reregistered=stored["reregistered"],
            paper=Paper(
                FlatField(page_mm, (red, green, blue)),
                white,
                error,
                stored["references"],
                spread,
                FieldResidual.from_json(stored["left"]),
            ),
            consistency=FrameConsistency.from_json(stored["consistency"]),
            greys=np.array(stored["greys"]).reshape(-1, 3),
            grey_errors=np.array(stored["grey_errors"]).reshape(-1, 3),
            dark=np.array(stored["dark"]),
            share_at_zero=stored["share_at_zero"],
            blur_px=stored["blur_px"],
            exposure=stored["exposure"],
            origin=FrameOrigin(**stored["origin"]),
        )
