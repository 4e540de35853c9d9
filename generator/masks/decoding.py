"""Values of an image file, whatever its format and depth."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from foundation.errors import FormatError
from generator.files import require_plausible


def decode_values(file: bytes, what: Path | str) -> npt.NDArray[Any]:
    """Return the values (H, W) or (H, W, 3), RGB, of the file's dtype (uint8, uint16, float32), no transparency."""
    import cv2

    require_plausible(file, str(what))
    data = np.frombuffer(file, np.uint8)
    image = cast("npt.NDArray[Any] | None", cv2.imdecode(data, cv2.IMREAD_UNCHANGED)) if data.size else None
    if image is None or image.ndim not in (2, 3):
        raise FormatError(f"{what} is no picture that can be read, or damaged; give masks as PNG or TIFF")
    if image.ndim == 2:
        return image
    return image[..., 0] if image.shape[2] < 3 else image[..., 2::-1]
