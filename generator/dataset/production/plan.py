"""What a dataset is to be, before a pixel is touched: every image has its number, every number its shard.

A dataset is a function of its table, its list of sources, the choice of lights, the seed and the options. Image number
`position · lights_each + k` shows the source at `position` under the k-th of its lights, whether or not the sources
before it can be read. Shard i holds the numbers from i · n up to (i + 1) · n, n the images of a shard. So any worker
can make any shard at any time, and a shard made twice is the same twice.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from pydantic import BaseModel, ConfigDict

from foundation.errors import InputError
from foundation.version import software
from generator.dataset.production.records import SPLITS, Layout, Light, Split, Table
from generator.files.formats import Format, libraries_of

if TYPE_CHECKING:
    from calibration.table.lut import Lut
    from generator.lights.lighting import LightChoice
    from generator.pictures.sources import Source

SHARD_IMAGES: Final = 256
"""Images of a shard unless said: what a kill costs at most, for each shard that was being made."""

_WORD: Final = 1 << 64


class Options(BaseModel):
    """What a dataset is asked to be, beside its table, sources, lights and seed.

    Attributes
    ----------
    form
        File format of the images; see `encode`.
    layout
        How images lie: each in its file, or many in a tar or Parquet file.
    previews
        Whether tone-mapped pictures go with them.
    split
        Shares of train, validation and test; None leaves the dataset undivided.
    shard_images
        Images of one shard.
    sources
        How sources were read, as plain values; recorded only.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    form: Format = "png"
    layout: Layout = "folder"
    previews: bool = True
    split: tuple[float, float, float] | None = None
    shard_images: int = SHARD_IMAGES
    sources: dict[str, Any] = {}


@dataclass(frozen=True)
class ShardJob:
    """All that a worker needs to make one shard, wherever it is.

    Attributes
    ----------
    table, table_sha256
        The table's folder, and its hash to compare with what is found there.
    shard, first, stop
        Its number, its first image number and the one after its last.
    position
        Place of the first of `sources` in the whole list.
    sources
        The sources that its images show.
    choice, seed, options
        As of the plan.
    versions
        What the bytes depend on beside all this; a worker must have the same.
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
    options: Options
    versions: dict[str, str]


@dataclass(frozen=True, eq=False)
class Plan:
    """A dataset to be made.

    Raises
    ------
    InputError
        There is nothing to make, or a number is out of range.
    """

    lut: Lut
    sources: Sequence[Source]
    choice: LightChoice
    seed: int
    options: Options

    def __post_init__(self) -> None:
        from generator.kernels.philox import key_of

        key_of(self.seed)
        if not self.sources or not self.choice.lights_each:
            raise InputError(
                f"{len(self.sources)} pictures under {self.choice.lights_each} lights make no image; name some of both"
            )
        if self.total > 1 << 32:
            raise InputError(f"{self.total} images are more than a dataset holds, 2^32; make several, each with a seed")
        if self.options.shard_images < 1:
            raise InputError(f"shards of {self.options.shard_images} images were asked for, expected 1 or more")
        if self.options.layout == "parquet":
            from generator.dataset.production.parquet import require_pyarrow

            require_pyarrow()
        check_shares(self.options.split)

    @property
    def total(self) -> int:
        """Images planned."""
        return len(self.sources) * self.choice.lights_each

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
        each = self.choice.lights_each
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
            **options.sources,
            "lights": self.choice.describe(),
            "previews": options.previews,
            "split": dict(zip(SPLITS, options.split, strict=True)) if options.split else None,
            "shard_images": options.shard_images,
        }
        return json.loads(json.dumps(recorded))


def check_shares(shares: tuple[float, float, float] | None) -> None:
    """Refuse shares of train, validation and test that are negative or do not sum to 1.

    Raises
    ------
    InputError
        They are so.
    """
    if shares is not None and not (min(shares) >= 0 and abs(sum(shares) - 1) < 1e-6):
        told = ",".join(f"{share:g}" for share in shares)
        raise InputError(f"the split {told} is to be three shares from 0 that sum to 1, such as 0.8,0.1,0.1")


def parse_split(text: str) -> tuple[float, float, float]:
    """Return the shares of train, validation and test of a text such as `0.8,0.1,0.1` or `80,10,10`.

    Two numbers are train and test.

    Raises
    ------
    InputError
        The text is no such list.
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


def parse_share(text: str) -> tuple[int, int]:
    """Return (i, n) of a text such as `3/16`: share i of n, i from 0.

    Raises
    ------
    InputError
        The text is no such share.
    """
    match = re.fullmatch(r"(\d{1,9})/(\d{1,9})", text.strip(), re.ASCII)
    if not match or not int(match[1]) < int(match[2]):
        raise InputError(f"{text!r} is no share; write I/N with I from 0 to N - 1, such as 0/16")
    return int(match[1]), int(match[2])


def split_of(shares: tuple[float, float, float] | None, seed: int, sha256: str | None, name: str) -> Split | None:
    """Return the part of the dataset that a source belongs to.

    Decided by the seed and the source's content, or its name where it has no file, so that no other source has a say
    and two copies of one file, whatever they are called, are in the same part. The shares hold on average.

    Parameters
    ----------
    shares
        Of train, validation and test; sum 1. None leaves it undivided.
    seed
        0 … 2⁶⁴ − 1.
    sha256
        Of the source's file.
    name
        What it is called.
    """
    if shares is None:
        return None
    word = hashlib.sha256(f"split {seed} {sha256 or name}".encode()).digest()[:8]
    place = int.from_bytes(word, "big") / _WORD
    bound = 0.0
    for part, share in zip(SPLITS, shares, strict=True):
        bound += share
        if place < bound and share:
            return part
    return max(zip(shares, SPLITS, strict=True))[1]


def sources_sha256(sources: Sequence[Source]) -> str:
    """Return a hash over the list of sources: what each is called, and how it is made or read.

    Where a file lies and what is in it are left out: a list is the same on every machine, and its files are hashed when
    they are read.
    """
    digest = hashlib.sha256()
    for source in sources:
        digest.update(json.dumps(source.told(), sort_keys=True).encode() + b"\n")
    return digest.hexdigest()


@lru_cache
def versions(form: Format, layout: Layout) -> dict[str, str]:
    """Return the versions of what decodes sources, finds lights and encodes images: others may give other bytes."""
    names = {"isal", "numpy", "OpenImageIO", "opencv-contrib-python-headless", "pillow", "scipy", "simplejpeg"}
    if layout == "parquet":
        names.add("pyarrow")
    return {name: importlib.metadata.version(name) for name in sorted(names | {*libraries_of(form)})}


def table_of(lut: Lut) -> Table:
    """Return what a dataset records of its table."""
    known = lut.provenance
    return Table(
        sha256=lut.sha256,
        camera=known.camera,
        bits=known.bits,
        samples=lut.samples.shape[2],
        white_level=known.white_level,
        software=known.software,
    )


def light_of(lut: Lut, light: int) -> Light:
    """Return what a dataset records of light number `light` of its table."""
    shown = lut.illuminations[light]
    red, green, blue = (float(part) for part in lut.white[light])
    return Light(
        illumination=light,
        kind=shown.kind,
        cct_k=shown.cct_k,
        codes=(shown.colour.red, shown.colour.green, shown.colour.blue),
        white=(red, green, blue),
    )
