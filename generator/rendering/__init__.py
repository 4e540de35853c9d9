"""Rendering by colour: cells of the chart that together show a camera what it should see of a picture."""

from typing import Literal

Rendering = Literal["codes", "colorimetric"]
