"""Write pictures with OpenImageIO."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import OpenImageIO as oiio  # noqa: N813


def write(path: Path, pixels: npt.NDArray[np.generic], form: str, **attributes: object) -> Path:
    """Write `pixels` (H, W, C) with OpenImageIO as `form` ("uint8", "half", ...)."""
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], form)
    for name, value in attributes.items():
        spec.attribute(name.replace("__", ":"), value)
    out: Any = oiio.ImageOutput.create(str(path))
    assert out is not None
    assert out.open(str(path), spec)
    assert out.write_image(pixels)
    out.close()
    return path
