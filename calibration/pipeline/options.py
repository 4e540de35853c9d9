"""What a user may choose about how a table is made; part of a growing table's identity."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from acquisition.framing.corners import Corners
from calibration.sampling.samples import WINDOW
from foundation.errors import InputError

WINDOWS = (3, 5, 7, 9)


@dataclass(frozen=True)
class Choices:
    """How a table is made.

    Attributes
    ----------
    window
        Pixels along the side of a cell's window: one of `WINDOWS`.
    subtract_dark
        Whether the light of the dark frames is subtracted from samples and ground truth.
    corners
        Four corners (x, y) of the field of cells in the frame that is registered, half-size px, clockwise from the
        printed top-left, for a chart without tags; None to have it found.

    Raises
    ------
    InputError
        The window is not one of those.
    """

    window: int = WINDOW
    subtract_dark: bool = False
    corners: Corners | None = None

    def __post_init__(self) -> None:
        if self.window not in WINDOWS:
            raise InputError(
                f"a window of {self.window} pixels was asked for; {', '.join(map(str, WINDOWS[:-1]))} or {WINDOWS[-1]} "
                "expected: it has a middle pixel, and cells are about 10 pixels wide"
            )

    @property
    def samples(self) -> int:
        """Samples of each cell."""
        return self.window**2

    def told(self) -> dict[str, Any]:
        """Return the choices as JSON holds them."""
        return asdict(self) | {"corners": None if self.corners is None else [list(corner) for corner in self.corners]}
