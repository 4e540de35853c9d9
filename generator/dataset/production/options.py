"""What a dataset is to be, beside its table, sources, lights and seed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final, get_args

from foundation.errors import InputError
from generator.dataset.production.records import Layout
from generator.files.formats import FORMATS, Format
from generator.variation.variation import NO_VARIATION, Variation

SHARD_IMAGES: Final = 256
"""Images of a shard unless said otherwise: all that a kill can cost, for each shard that was being made."""


@dataclass(frozen=True)
class DatasetOptions:
    """What a dataset is to be, beside its table, sources, lights and seed.

    Attributes
    ----------
    form
        File format of the images; see `generator.files.formats`.
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

    @property
    def has_details(self) -> bool:
        """Whether options do something to each image that is recorded of it: `images.csv` lists it then."""
        return self.variation.is_on or self.crops > 1 or self.weighted

    def __post_init__(self) -> None:
        for what, value, known in (("format", self.form, FORMATS), ("layout", self.layout, get_args(Layout))):
            if value not in known:
                raise InputError(f"{value!r} is no {what} of a dataset; use one of {', '.join(known)}")
        if self.shard_images < 1:
            raise InputError(f"shards of {self.shard_images} images were asked for, expected 1 or more")
        if self.crops < 1:
            raise InputError(f"{self.crops} crops of each picture were asked for, expected 1 or more")
        split = self.split
        if split is not None and not (len(split) == 3 and min(split) >= 0 and abs(sum(split) - 1) < 1e-6):
            shares = ",".join(f"{share:g}" for share in split)
            raise InputError(f"the split {shares} is to be three shares from 0 that sum to 1, such as 0.8,0.1,0.1")


def parse_split(text: str) -> tuple[float, float, float]:
    """Return the shares of train, validation and test of a text such as `0.8,0.1,0.1` or `80,10,10`.

    Two numbers are train and test.

    Raises
    ------
    InputError
        The text is no such list.

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
