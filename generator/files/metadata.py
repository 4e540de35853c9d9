"""The metadata of an image, which go into its file wherever the format has a place for them."""

from __future__ import annotations

import json
from dataclasses import dataclass


@dataclass(frozen=True)
class ImageMetadata:
    """Light and camera of one image.

    - `white_level`: value of saturation, 1 … 65535, in the units of the image.
    - `white`: linear camera RGB of an achromatic surface under the image's light, of any length: the ground truth.
    - `camera`: maker and model, as the table has it.
    """

    white_level: int
    white: tuple[float, float, float]
    camera: str

    def to_json(self) -> str:
        """Return one line of JSON in ASCII, for formats with a place for a text."""
        values = {"white_level": self.white_level, "white": self.white, "camera": self.camera}
        return json.dumps({"format": "crop.image", "values": "linear camera RGB, black 0", **values})
