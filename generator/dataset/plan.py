"""What a dataset is to be, before a pixel is touched: every image has its number, every number its shard.

A dataset is a function of its table, its list of sources, the choice of lights, the seed and the options. Image number
`(position · crops + c) · lights_each + k` shows crop c of the source at `position` (the one, or the whole, unless
several are asked for) under the k-th light of scene `position · crops + c`, whether or not the sources before it can be
read. Shard i holds the numbers from i · n up to (i + 1) · n, n the images of a shard. So any worker can make any shard
at any time, and a shard made twice is the same twice.

Each source falls into a part of the split by its own hash.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, get_args

from foundation.errors import InputError
from foundation.secret_texts import masked_values
from foundation.version import software
from generator.dataset.layouts import LAYOUTS, require_library
from generator.dataset.records import SPLITS, Layout, TableRecord
from generator.files import FORMATS, Format, libraries_of
from generator.philox import key_of
from generator.rendering import DEFAULT, Rendering
from generator.rendering.black_points import KEEP, BlackPoint
from generator.rendering.matrices import ColourMatrix, matrix_for
from generator.variation.variation import Variation

if TYPE_CHECKING:
    from calibration.table.lut import Lut
    from generator.lights.lighting import LightChoice
    from generator.pictures.sources import Source


# Images of a shard unless said otherwise: all that a kill can cost, for each shard that was being made.
SHARD_IMAGES: Final = 256

# Of colorimetric rendering: rises when its rules change, so that other pixels come of the same options. 1 took the
# grey in the print's black cell out where 2 takes the grey that black was mapped to; 3 tries more cells for greys
# that 2 left off by .2 degrees and more; 4 prints through one map of the chart, interpolated between cells, where
# those before it mixed cells for each light.
RENDERING_VERSION: Final = 4


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
    rendering
        ``"colorimetric"``: the print shows the camera the picture's colours; ``"codes"``: codes of a picture are those
        of the print, the paper's way.
    matrix
        Linear sRGB to the camera's RGB, for colorimetric rendering; None for that of the table's camera.
    black_point
        What becomes of the print's black.
    uncertainty
        Whether `ground_truth.csv` has what each light's direction may be off by, as the table states it.

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
    variation: Variation | None = None
    crops: int = 1
    reading: Mapping[str, Any] = field(default_factory=dict[str, Any])
    rendering: Rendering = DEFAULT
    matrix: ColourMatrix | None = None
    black_point: BlackPoint = KEEP
    uncertainty: bool = False

    @property
    def has_details(self) -> bool:
        """Whether options do something to each image that is recorded of it: `images.csv` lists it then."""
        return self.variation is not None or self.crops > 1 or self.is_rendered

    @cached_property
    def tints(self) -> bool:
        """Whether the light of an image changes its colour over it, so that images have maps of it."""
        return self.variation is not None and self.variation.tints

    @property
    def is_rendered(self) -> bool:
        """Whether images are not rendered by codes with the print's black kept."""
        return self.rendering != "codes" or self.black_point.kind != "keep"

    def describe_rendering(self, lut: Lut) -> dict[str, Any]:
        """Return how images are rendered as plain values; nothing for codes with the print's black kept."""
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
        ):
            if value not in known:
                raise InputError(f"{value!r} is no {what} of a dataset; use one of {', '.join(known)}")
        if self.rendering == "codes" and self.matrix is not None:
            raise InputError("a colour matrix is for colorimetric rendering; choose that, or leave the matrix out")
        if self.shard_images < 1:
            raise InputError(f"shards of {self.shard_images} images were asked for, expected 1 or more")
        if self.crops < 1:
            raise InputError(f"{self.crops} crops of each picture were asked for, expected 1 or more")
        split = self.split
        if split is not None and not (len(split) == 3 and min(split) >= 0 and abs(sum(split) - 1) < _ROUNDED):
            shares = ",".join(f"{share:g}" for share in split)
            raise InputError(f"the split {shares} is to be three shares from 0 that sum to 1, such as 0.8,0.1,0.1")


_ROUNDED: Final = 1e-6  # By which a sum of shares may differ from 1


def parse_split(text: str) -> tuple[float, float, float]:
    """Return the shares of train, validation and test of a text such as `0.8,0.1,0.1` or `80,10,10`.

    Two numbers are train and test. Whole numbers and percentages are scaled to the sum 1; other shares must have it.
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
    whole = total >= 1 and all(part == int(part) for part in parts)
    if not (whole or abs(total - 1) < _ROUNDED or abs(total - 100) < 100 * _ROUNDED):
        raise InputError(
            f"the split {text} sums to {total:.10g}, and every picture is put into a part; expected shares that sum to "
            "1, such as 0.8,0.1,0.1, or whole numbers such as 8,1,1"
        )
    return parts[0] / total, parts[1] / total, parts[2] / total


@dataclass(frozen=True)
class ShardJob:
    """Everything that a worker on any machine needs to make one shard.

    - `table`, `table_sha256`: the table's folder, and its hash to compare with what is found there.
    - `shard`, `first`, `stop`: its number, its first image number and the one after its last.
    - `position`: place of the first of `sources` in the whole list.
    - `sources`: the sources that its images show.
    - `choice`, `seed`, `options`: those of the plan.
    - `versions`: versions of the libraries that the bytes depend on; a worker must have the same.
    """

    table: Path
    table_sha256: str
    shard: int
    first: int
    stop: int
    position: int
    sources: tuple[Source, ...]
    choice: LightChoice
    seed: int
    options: DatasetOptions
    versions: dict[str, str]


@dataclass(frozen=True, eq=False)
class Plan:
    """A dataset to be made."""

    lut: Lut
    sources: Sequence[Source]
    choice: LightChoice
    seed: int
    options: DatasetOptions

    def __post_init__(self) -> None:
        key_of(self.seed)
        if not self.sources or not self.choice.lights_each:
            raise InputError(
                f"{len(self.sources)} pictures under {self.choice.lights_each} lights make no image; name some of both"
            )
        if self.total > 1 << 32:
            raise InputError(f"{self.total} images are more than a dataset holds, 2^32; make several, each with a seed")
        if self.options.tints and any(lighting.masks for lighting in self.choice.lightings_of(0)):
            raise InputError(
                "a gradient with a colour and several lights an image were both asked for, but masks tell either; "
                "leave out colour, or ask for one light"
            )
        require_library(self.options.layout)

    @property
    def total(self) -> int:
        """Images planned."""
        return len(self.sources) * self.images_each

    @property
    def images_each(self) -> int:
        """Images of each source."""
        return self.options.crops * self.choice.lights_each

    @property
    def shards(self) -> int:
        """Shards they are cut into."""
        return -(-self.total // self.options.shard_images)

    def images_of(self, shard: int) -> int:
        """Return how many images are planned for a shard."""
        return min(self.options.shard_images, self.total - shard * self.options.shard_images)

    def job(self, shard: int) -> ShardJob:
        """Return the task of shard number `shard`."""
        first = shard * self.options.shard_images
        stop = first + self.images_of(shard)
        each = self.images_each
        places = range(first // each, (stop - 1) // each + 1)
        return ShardJob(
            table=self.lut.folder.resolve(),
            table_sha256=self.lut.sha256,
            shard=shard,
            first=first,
            stop=stop,
            position=places[0],
            sources=tuple(self.sources[place] for place in places),
            choice=self.choice,
            seed=self.seed,
            options=self.options,
            versions=versions(self.options.form, self.options.layout),
        )

    def identity(self) -> dict[str, Any]:
        """Return plain values that two plans share exactly if they make the same bytes."""
        return {
            "format": "crop.plan",
            "version": 1,
            "software": software(),
            "libraries": versions(self.options.form, self.options.layout),
            "table": table_of(self.lut).model_dump(mode="json"),
            "seed": self.seed,
            "options": self.recorded_options(),
            "images": self.total,
            "lights_each": self.choice.lights_each,
            "shards": self.shards,
            "sources": {"count": len(self.sources), "sha256": sources_sha256(self.sources)},
        }

    def recorded_options(self) -> dict[str, Any]:
        """Return the options as `dataset.json` has them; through JSON, so that they compare with what is read back."""
        options = self.options
        recorded = {
            "format": options.form,
            "layout": options.layout,
            **options.reading,
            **options.describe_rendering(self.lut),
            "lights": self.choice.describe(),
            "previews": options.previews,
            "split": dict(zip(SPLITS, options.split, strict=True)) if options.split else None,
            "shard_images": options.shard_images,
        }
        # What is off is no key: such datasets keep their bytes.
        if options.variation is not None:
            recorded["variation"] = options.variation.describe()
        if options.crops > 1:
            recorded["crops"] = options.crops
        if options.uncertainty:
            recorded["uncertainty"] = True
        # A data set is published: addresses in it have no secrets.
        return json.loads(json.dumps(masked_values(recorded)))


def sources_sha256(sources: Sequence[Source]) -> str:
    """Return a hash over the list of sources: the name of each, and how it is made or read.

    Where a file lies and what is in it are left out: a list is the same on every machine, and its files are hashed when
    they are read.
    """
    digest = hashlib.sha256()
    for source in sources:
        digest.update(json.dumps(source.to_json(), sort_keys=True).encode() + b"\n")
    return digest.hexdigest()


@lru_cache
def versions(form: Format, layout: Layout) -> dict[str, str]:
    """Return the versions of the libraries that decode sources, find lights and encode images, by their names.

    Other versions may give other bytes.
    """
    names = {"isal", "numpy", "OpenImageIO", "opencv-contrib-python-headless", "pillow", "scipy", "simplejpeg"}
    needed = {*libraries_of(form), LAYOUTS[layout].library} - {""}
    return {name: importlib.metadata.version(name) for name in sorted(names | needed)}


def table_of(lut: Lut) -> TableRecord:
    """Return the record of the table."""
    provenance = lut.provenance
    return TableRecord(
        sha256=lut.sha256,
        camera=provenance.camera,
        bits=provenance.bits,
        samples=lut.samples.shape[2],
        white_level=provenance.white_level,
        software=provenance.software,
        computed=provenance.computed,
        lights=len(lut.illuminations),
        origin=provenance.origin,
    )
