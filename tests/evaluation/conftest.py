"""Real thumbnails to compare published figures with, where the data are at hand."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

THUMBNAILS = Path(__file__).parents[2].parent / "shared" / "data" / "benchmark" / "nus_canon_1ds_mk3_64x64.npz"


@dataclass(frozen=True)
class Thumbnail:
    """A real linear raw thumbnail; pixels of the masked chart are exactly zero."""

    name: str
    truth: npt.NDArray[np.float64]
    image: npt.NDArray[np.float32]
    saturation: float | None = None

    def read(self) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.bool_]]:
        return self.image, (self.image == 0).all(axis=2)


@pytest.fixture(scope="session")
def thumbnails() -> list[Thumbnail]:
    if not THUMBNAILS.is_file():
        pytest.skip("the thumbnails of the NUS Canon 1Ds Mark III are not at hand")
    with np.load(THUMBNAILS) as data:
        rows = zip(data["names"], data["gt"], data["images"], strict=True)
        return [Thumbnail(str(name), truth, image) for name, truth, image in rows]
