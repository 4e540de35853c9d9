"""What a dataset is to be, before a pixel is touched: every image has its number, every number its shard.

A dataset is a function of its table, its list of sources, the choice of lights, the seed and the options. Image number
`(position · crops + c) · lights_each + k` shows crop c of the source at `position` (the one, or the whole, unless
several are asked for) under the k-th light of scene `position · crops + c`, whether or not the sources before it can be
read. Shard i holds the numbers from i · n up to (i + 1) · n, n the images of a shard. So any worker
can make any shard at any time, and a shard made twice is the same twice.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from foundation.errors import InputError
from foundation.secret_texts import masked_values
from foundation.version import software
from generator.dataset.production.layouts.by_name import require_libraries
from generator.dataset.production.options import DatasetOptions
from generator.dataset.production.records import SPLITS, Layout, Light, Split, TableRecord
from generator.files import Format, libraries_of

if TYPE_CHECKING:
    from calibration.table.lut import Lut
    from generator.lights.lighting import LightChoice
    from generator.pictures.sources import Source

_WORD: Final = 1 << 64
"""Values of the eight bytes of a hash that place a source among the parts."""


@dataclass(frozen=True)
class ShardJob:
    """Everything that a worker on any machine needs to make one shard.

    - `table`, `table_sha256`: the table's folder, and its hash to compare with what is found there.
    - `shard`, `first`, `stop`: its number, its first image number and the one after its last.
    - `position`: place of the first of `sources` in the whole list.
    - `sources`: the sources that its images show.
    - `choice`, `seed`, `options`: those of the plan.
    - `versions`: versions of the libraries that the bytes depend on; a worker must have the same.
    - `parts`: the part of each of `sources`, where they were decided together; empty where each is by itself.
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
    parts: tuple[Split, ...] = ()


@dataclass(frozen=True, eq=False)
class Plan:
    """A dataset to be made."""

    lut: Lut
    sources: Sequence[Source]
    choice: LightChoice
    seed: int
    options: DatasetOptions

    def __post_init__(self) -> None:
        from generator.philox import key_of

        key_of(self.seed)
        if not self.sources or not self.choice.lights_each:
            raise InputError(
                f"{len(self.sources)} pictures under {self.choice.lights_each} lights make no image; name some of both"
            )
        if self.total > 1 << 32:
            raise InputError(f"{self.total} images are more than a dataset holds, 2^32; make several, each with a seed")
        if self.options.variation.tints and any(lighting.masks for lighting in self.choice.lightings_of(0)):
            raise InputError(
                "a gradient with a colour and several lights an image were both asked for, but masks tell either; "
                "leave out colour, or ask for one light"
            )
        kept = self.options.bits
        if self.options.rendering == "codes" and kept is not None and kept > self.lut.provenance.bits:
            raise InputError(
                f"{kept} bits of each code were to be kept, where the table has {self.lut.provenance.bits}; ask for "
                "fewer"
            )
        require_libraries(self.options.layout)

    @cached_property
    def parts(self) -> tuple[Split, ...]:
        """The part of each source, where parts have exact sizes; empty otherwise."""
        if not self.options.split_exact or self.options.split is None:
            return ()
        from generator.dataset.production.exact_split import exact_parts

        return exact_parts(self.sources, self.options.split, self.seed)

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
            parts=tuple(self.parts[place] for place in places) if self.parts else (),
        )

    def identity(self) -> dict[str, Any]:
        """Return plain values that two plans share exactly if they make the same bytes."""
        # Copies of a file are told by its content, which is not in the list of sources.
        parts = {"parts": hashlib.sha256(" ".join(self.parts).encode()).hexdigest()} if self.parts else {}
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
            **parts,
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
        if options.variation.is_on:
            recorded["variation"] = options.variation.describe()
        if options.crops > 1:
            recorded["crops"] = options.crops
        if options.bits is not None:
            recorded["bits"] = options.bits
        if options.scale != "table":
            recorded["scale"] = options.scale
        if options.split_exact:
            recorded["split_exact"] = True
        # A data set is published: addresses in it have no secrets.
        return json.loads(json.dumps(masked_values(recorded)))


def split_of(shares: tuple[float, float, float] | None, seed: int, sha256: str | None, name: str) -> Split | None:
    """Return the part of the dataset that a source belongs to.

    Decided by the seed and the source's content, or its name where it has no file, and by no other source, so that two
    copies of one file, whatever their names, are in the same part. The shares hold on average.

    `shares`: of train, validation and test; sum 1. None leaves it undivided.
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
    if layout == "parquet":
        names.add("pyarrow")
    return {name: importlib.metadata.version(name) for name in sorted(names | {*libraries_of(form)})}


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


def light_of(lut: Lut, light: int) -> Light:
    """Return the record of light number `light` of the table."""
    shown = lut.illuminations[light]
    red, green, blue = (float(part) for part in lut.white[light])
    return Light(
        illumination=light,
        kind=shown.kind,
        cct_k=shown.cct_k,
        codes=shown.colour.codes,
        white=(red, green, blue),
        name=shown.name,
    )
