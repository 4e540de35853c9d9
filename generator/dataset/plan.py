"""Plan of a data set: it assigns a number to every image and a shard to every number.

A data set is a function of its LUT, sources, choice of illuminants, seed and options. A scene is a crop of a source, or
the whole source. Crop c of the source at `position` is scene s = `position · crops + c`. Image `s · lights_each + k`
shows scene s under its illuminant k. Its number does not depend on whether other sources can be read. A shard has
n images; shard i has the numbers from i · n to (i + 1) · n − 1. Any worker can therefore make any shard at any time,
and a shard that is made twice has the same bytes.
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
from generator.dataset.layouts import LAYOUTS, require_format, require_library
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


# Default number of images in a shard. A kill loses at most this number for each shard in progress.
SHARD_IMAGES: Final = 256

# Version of colorimetric rendering. It is increased when equal options give other pixels.
RENDERING_VERSION: Final = 5


@dataclass(frozen=True)
class DatasetOptions:
    """Options of a data set in addition to its LUT, sources, illuminants and seed.

    Attributes
    ----------
    form
        File format of the images: ``"png"``, ``"tiff"``, ``"exr"``, ``"jxl"`` or ``"dng"``.
    layout
        ``"folder"`` or ``"c5"``: one file for each image; ``"webdataset"`` or ``"parquet"``: one file for each shard.
    previews
        Whether tone-mapped previews are written.
    split
        Shares of train, validation and test, 0 … 1, sum 1; None for an undivided data set.
    shard_images
        Number of images in a shard, 1 or more.
    variation
        Random exposure, fall-off and noise of each image (`generator.variation`), or None.
    crops
        Number of crops of each picture, 1 or more; the sources must be prepared with the same number.
    reading
        Record of the preparation of the sources, plain values for `dataset.json`. It does not change the images.
    rendering
        ``"colorimetric"``: the print reproduces the colours of the picture; ``"codes"``: the codes of the picture are
        the codes of the print, as in the paper.
    matrix
        Matrix from linear sRGB to camera RGB for colorimetric rendering; None: matrix of the camera of the LUT.
    black_point
        Treatment of the black of the print.
    uncertainty
        Whether `ground_truth.csv` has the uncertainty of each ground truth (degrees, k = 2).

    Raises
    ------
    InputError
        An option is invalid.

    Examples
    --------
    >>> DatasetOptions(layout="parquet", split=(0.8, 0.1, 0.1)).shard_images
    256
    >>> DatasetOptions(split=(0.8, 0.1, 0.2))
    Traceback (most recent call last):
    foundation.errors.InputError: the split is 0.8,0.1,0.2, expected three shares ≥ 0 with the sum 1 ...
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
        """Whether `images.csv` records details of each image."""
        return self.variation is not None or self.crops > 1 or self.is_rendered

    @cached_property
    def tints(self) -> bool:
        """Whether the colour of the illuminant changes over an image, so that images have maps of it."""
        return self.variation is not None and self.variation.tints

    @property
    def is_rendered(self) -> bool:
        """Whether the options differ from rendering by codes that keeps the black of the print."""
        return self.rendering != "codes" or self.black_point.kind != "keep"

    def describe_rendering(self, lut: Lut) -> dict[str, Any]:
        """Return the rendering as plain values; empty for rendering by codes that keeps the black of the print."""
        described: dict[str, Any] = {}
        if self.rendering == "colorimetric":
            used = self.matrix or matrix_for(lut)
            rows = [[float(number) for number in row] for row in used.rows]
            matrix = {"name": used.name, "source": used.source, "rows": rows}
            described["rendering"] = {"name": self.rendering, "version": RENDERING_VERSION, "matrix": matrix}
        if self.black_point.kind != "keep":
            described["black_point"] = self.black_point.label
        return described

    def __post_init__(self) -> None:
        for option_name, value, choices in (
            ("format", self.form, FORMATS),
            ("layout", self.layout, get_args(Layout)),
            ("rendering", self.rendering, get_args(Rendering)),
        ):
            if value not in choices:
                raise InputError(
                    f"the {option_name} of a data set is {value!r}, expected one of {', '.join(choices)}; correct it"
                )
        require_format(self.layout, self.form)
        if self.rendering == "codes" and self.matrix is not None:
            raise InputError("a colour matrix needs colorimetric rendering, but rendering is codes; omit the matrix")
        if self.shard_images < 1:
            raise InputError(f"shard_images is {self.shard_images}, expected 1 or more; correct it")
        if self.crops < 1:
            raise InputError(f"crops is {self.crops}, expected 1 or more; correct it")
        split = self.split
        if split is not None and not (len(split) == 3 and min(split) >= 0 and abs(sum(split) - 1) < _SUM_TOLERANCE):
            shares = ",".join(f"{share:g}" for share in split)
            raise InputError(
                f"the split is {shares}, expected three shares ≥ 0 with the sum 1 as in 0.8,0.1,0.1; correct it"
            )


_SUM_TOLERANCE: Final = 1e-6  # Allowed difference of a sum of shares from 1


def parse_split(text: str) -> tuple[float, float, float]:
    """Return the shares of train, validation and test in a text such as `0.8,0.1,0.1` or `80,10,10`.

    Two numbers mean train and test. Integers and percentages are scaled to the sum 1; other shares must have this sum.
    """
    try:
        shares = [float(share) for share in text.split(",")]
    except ValueError:
        shares = []
    if len(shares) == 2:
        shares.insert(1, 0.0)
    if len(shares) != 3 or not min(shares) >= 0 or not 0 < sum(shares) < float("inf"):
        raise InputError(
            f"the split is {text!r}, expected shares of train, validation and test such as 0.8,0.1,0.1; correct it"
        )
    total = sum(shares)
    is_whole = total >= 1 and all(share == int(share) for share in shares)
    if not (is_whole or abs(total - 1) < _SUM_TOLERANCE or abs(total - 100) < 100 * _SUM_TOLERANCE):
        raise InputError(
            f"the split {text} has the sum {total:.10g}, expected 1; give shares such as 0.8,0.1,0.1, or integers such "
            "as 8,1,1"
        )
    # Shares with the sum 1 stay as typed: a division by 0.9999999999999999 would change their last digit.
    divisor = total if is_whole else 100.0 if total > 2 else 1.0
    return shares[0] / divisor, shares[1] / divisor, shares[2] / divisor


@dataclass(frozen=True)
class ShardJob:
    """All data that a worker on any machine needs to make one shard."""

    table: Path  # folder of the LUT
    table_sha256: str  # the worker compares the LUT with this hash
    shard: int
    first: int  # first image number
    stop: int  # last image number + 1
    position: int  # position of the first source of this shard in the plan
    sources: tuple[Source, ...]  # sources of the images in this shard
    choice: LightChoice
    seed: int
    options: DatasetOptions
    versions: dict[str, str]  # versions of libraries that may change bytes; the worker must have the same


@dataclass(frozen=True, eq=False)
class Plan:
    """Plan of a data set."""

    lut: Lut
    sources: Sequence[Source]
    choice: LightChoice
    seed: int
    options: DatasetOptions

    def __post_init__(self) -> None:
        key_of(self.seed)
        if not self.sources or not self.choice.lights_each:
            raise InputError(
                f"the plan has {len(self.sources)} pictures and {self.choice.lights_each} illuminants, expected 1 or "
                "more of each; add some"
            )
        if self.total > 1 << 32:
            raise InputError(f"the plan has {self.total} images, expected at most 2^32; make several data sets")
        if self.options.tints and any(lighting.masks for lighting in self.choice.lightings_of(0)):
            raise InputError(
                "the images have a gradient with colour and several illuminants, expected at most one of both, because "
                "both need the masks; omit the colour of the gradient, or use one illuminant"
            )
        require_library(self.options.layout)

    @property
    def total(self) -> int:
        """Number of planned images."""
        return len(self.sources) * self.images_each

    @property
    def images_each(self) -> int:
        """Number of images of each source."""
        return self.options.crops * self.choice.lights_each

    @property
    def shards(self) -> int:
        """Number of shards."""
        return -(-self.total // self.options.shard_images)

    def images_of(self, shard: int) -> int:
        """Return the number of planned images of a shard."""
        return min(self.options.shard_images, self.total - shard * self.options.shard_images)

    def job(self, shard: int) -> ShardJob:
        """Return the job of a shard."""
        first = shard * self.options.shard_images
        stop = first + self.images_of(shard)
        images_each = self.images_each
        positions = range(first // images_each, (stop - 1) // images_each + 1)
        return ShardJob(
            table=self.lut.folder.resolve(),
            table_sha256=self.lut.sha256,
            shard=shard,
            first=first,
            stop=stop,
            position=positions[0],
            sources=tuple(self.sources[position] for position in positions),
            choice=self.choice,
            seed=self.seed,
            options=self.options,
            versions=versions(self.options.form, self.options.layout),
        )

    def identity(self) -> dict[str, Any]:
        """Return plain values that are equal for two plans if and only if both plans make the same bytes."""
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
        """Return the options as in `dataset.json`, converted to JSON types so that they compare with a read file."""
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
        # Unused options add no key, so that data sets without them keep their bytes between versions.
        if options.variation is not None:
            recorded["variation"] = options.variation.describe()
        if options.crops > 1:
            recorded["crops"] = options.crops
        if options.uncertainty:
            recorded["uncertainty"] = True
        # Data sets are published, so secrets in addresses are masked.
        return json.loads(json.dumps(masked_values(recorded)))


def sources_sha256(sources: Sequence[Source]) -> str:
    """Return a hash of the names and preparations of all sources."""
    # Folders and contents are not included: the hash is equal on every machine, and files are hashed when they are
    # read.
    digest = hashlib.sha256()
    for source in sources:
        digest.update(json.dumps(source.to_json(), sort_keys=True).encode() + b"\n")
    return digest.hexdigest()


@lru_cache
def versions(form: Format, layout: Layout) -> dict[str, str]:
    """Return the versions of the libraries that may change bytes, by name."""
    names = {"isal", "numpy", "OpenImageIO", "opencv-contrib-python-headless", "pillow", "scipy", "simplejpeg"}
    needed = {*libraries_of(form), LAYOUTS[layout].library} - {""}
    return {name: importlib.metadata.version(name) for name in sorted(names | needed)}


def table_of(lut: Lut) -> TableRecord:
    """Return the record of the LUT."""
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
