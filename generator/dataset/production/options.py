"""What a dataset is to be, beside its table, sources, lights and seed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, get_args

from foundation.errors import InputError
from generator.dataset.production.records import Layout, Scale
from generator.files import FORMATS, Format
from generator.rendering import Rendering
from generator.rendering.black_points import KEEP, BlackPoint
from generator.rendering.matrices import ColourMatrix
from generator.variation.variation import NO_VARIATION, Variation

if TYPE_CHECKING:
    from calibration.table.lut import Lut

SHARD_IMAGES: Final = 256
"""Images of a shard unless said otherwise: all that a kill can cost, for each shard that was being made."""

RENDERING: Final[Rendering] = "codes"
"""Rendering unless said otherwise: the paper's."""
STRETCHED: Final[tuple[Format, ...]] = ("png", "tiff", "jxl")
"""Formats without a place for the white level that readers use, whose counts may be stretched over 16 bits."""

RENDERING_VERSION: Final = 3
"""Of colorimetric rendering: rises when its rules change, so that other pixels come of the same options.
1 took the grey in the print's black cell out where 2 takes the grey that black was mapped to; 3 tries more cells for
greys that 2 left off by .2 degrees and more."""


@dataclass(frozen=True)
class DatasetOptions:
    """What a dataset is to be, beside its table, sources, lights and seed.

    Attributes
    ----------
    form
        File format of the images; see `generator.files`.
    layout
        How images lie: each in its file, or those of a shard in a tar or Parquet file.
    previews
        Whether tone-mapped pictures go with them.
    split
        Shares of train, validation and test, 0 … 1, sum 1; None leaves the dataset undivided.
    shard_images
        Images of one shard, 1 or more.
    variation
        What differs from image to image beside scene and light; see `generator.variation`.
    crops
        Crops of each picture, 1 or more; of more than one the sources must have as many.
    reading
        How sources were read, as plain values; recorded only.
    weighted
        Whether sources were drawn by weights, which are recorded of each image.
    rendering
        ``"codes"``: codes of a picture are those of the print, the paper's way; ``"colorimetric"``: the print shows
        the camera the picture's colours.
    matrix
        Linear sRGB to the camera's RGB, for colorimetric rendering; None for that of the table's camera.
    black_point
        What becomes of the print's black.
    bits
        Bits kept of each code of the pictures, the others set to zero before they are printed; None keeps those that
        the table tells apart.
    scale
        ``"table"`` stores counts as they are; ``"full"`` stretches them over 16 bits, see `generator.files`.
    split_exact
        Whether parts have exactly the sizes of `split`, and not on average.

    Raises
    ------
    InputError
        An option is none of these.

    Examples
    --------
    >>> DatasetOptions(layout="parquet", split=(0.8, 0.1, 0.1)).shard_images
    256
    >>> DatasetOptions(split=(0.8, 0.1, 0.2))
    Traceback (most recent call last):
    foundation.errors.InputError: the split 0.8,0.1,0.2 is to be three shares from 0 that sum to 1, such as 0.8,0.1,0.1
    """

    form: Format = "png"
    layout: Layout = "folder"
    previews: bool = True
    split: tuple[float, float, float] | None = None
    shard_images: int = SHARD_IMAGES
    variation: Variation = NO_VARIATION
    crops: int = 1
    reading: Mapping[str, Any] = field(default_factory=dict[str, Any])
    weighted: bool = False
    rendering: Rendering = RENDERING
    matrix: ColourMatrix | None = None
    black_point: BlackPoint = KEEP
    bits: int | None = None
    scale: Scale = "table"
    split_exact: bool = False

    @property
    def has_details(self) -> bool:
        """Whether options do something to each image that is recorded of it: `images.csv` lists it then."""
        return self.variation.is_on or self.crops > 1 or self.weighted or self.is_rendered

    @property
    def is_rendered(self) -> bool:
        """Whether images are not rendered by codes with the print's black kept."""
        return self.rendering != "codes" or self.black_point.kind != "keep"

    def describe_rendering(self, lut: Lut) -> dict[str, Any]:
        """Return how images are rendered as plain values; nothing for codes with the print's black kept."""
        from generator.rendering.matrices import matrix_for

        described: dict[str, Any] = {}
        if self.rendering == "colorimetric":
            used = self.matrix or matrix_for(lut)
            rows = [[float(part) for part in row] for row in used.rows]
            matrix = {"name": used.name, "source": used.source, "rows": rows}
            described["rendering"] = {"name": self.rendering, "version": RENDERING_VERSION, "matrix": matrix}
        if self.black_point.kind != "keep":
            described["black_point"] = self.black_point.label
        return described

    def __post_init__(self) -> None:
        for what, value, known in (
            ("format", self.form, FORMATS),
            ("layout", self.layout, get_args(Layout)),
            ("rendering", self.rendering, get_args(Rendering)),
            ("scale", self.scale, get_args(Scale)),
        ):
            if value not in known:
                raise InputError(f"{value!r} is no {what} of a dataset; use one of {', '.join(known)}")
        if self.rendering == "codes" and self.matrix is not None:
            raise InputError("a colour matrix is for colorimetric rendering; choose that, or leave the matrix out")
        if self.shard_images < 1:
            raise InputError(f"shards of {self.shard_images} images were asked for, expected 1 or more")
        if self.bits is not None and not 1 <= self.bits <= 8:
            raise InputError(f"{self.bits} bits of each code were to be kept, expected 1 to 8")
        if self.scale == "full" and self.form not in STRETCHED:
            raise InputError(
                f"counts of {self.form} are not stretched: the file says what white is; use one of "
                f"{', '.join(STRETCHED)}, or leave the scale as it is"
            )
        if self.split_exact and self.split is None:
            raise InputError("exact parts were asked for without their sizes; give a split such as 0.8,0.1,0.1")
        if self.crops < 1:
            raise InputError(f"{self.crops} crops of each picture were asked for, expected 1 or more")
        split = self.split
        if split is not None and not (len(split) == 3 and min(split) >= 0 and abs(sum(split) - 1) < 1e-6):
            shares = ",".join(f"{share:g}" for share in split)
            raise InputError(f"the split {shares} is to be three shares from 0 that sum to 1, such as 0.8,0.1,0.1")


def parse_split(text: str) -> tuple[float, float, float]:
    """Return the shares of train, validation and test of a text such as `0.8,0.1,0.1` or `80,10,10`.

    Two numbers are train and test.

    Examples
    --------
    >>> parse_split("80,10,10"), parse_split("3,1")
    ((0.8, 0.1, 0.1), (0.75, 0.0, 0.25))
    """
    try:
        parts = [float(part) for part in text.split(",")]
    except ValueError:
        parts = []
    if len(parts) == 2:
        parts.insert(1, 0.0)
    if len(parts) != 3 or not min(parts) >= 0 or not 0 < sum(parts) < float("inf"):
        raise InputError(f"the split {text!r} is to be shares of train, validation and test, such as 0.8,0.1,0.1")
    total = sum(parts)
    return parts[0] / total, parts[1] / total, parts[2] / total
