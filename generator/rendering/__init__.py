"""Rendering of source pictures by colour: the camera records the colours of the picture."""

from typing import Final, Literal

Rendering = Literal["codes", "colorimetric"]

DEFAULT: Final[Rendering] = "colorimetric"  # Default rendering (decision 0043)
