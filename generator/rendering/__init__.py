"""Rendering by colour: cells of the chart that together show a camera what it should see of a picture."""

from typing import Final, Literal

Rendering = Literal["codes", "colorimetric"]

DEFAULT: Final[Rendering] = "colorimetric"  # Rendering unless said otherwise (decision 0043)
