"""Scenes of given pixels for tests."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True, eq=False)
class Made:
    """A scene in memory."""

    name: str
    truth: npt.NDArray[np.float64]
    image: npt.NDArray[Any]
    saturation: float | None = None
    mask: npt.NDArray[np.bool_] | None = None

    def read(self) -> tuple[npt.NDArray[Any], npt.NDArray[np.bool_] | None]:
        return self.image, self.mask
