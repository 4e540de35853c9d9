"""One shard, from its sources to the record that says it is done.

Rules that hold inside:

- A shard's bytes depend on its job alone: not on the workers, on other shards, or on how often it is made.
- Its record is written last, when all else has been synchronised with the disk: a shard with a record is whole. The
  program may be killed at any instruction, and any number of programs may make the same shard at once.
- At most about three pictures are in memory for each worker.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Generator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from foundation.errors import FormatError, InputError
from generator.dataset.production.image_light import image_light
from generator.dataset.production.layouts.by_name import open_writer
from generator.dataset.production.layouts.samples import Sample, ShardWriter
from generator.dataset.production.photographing import photograph
from generator.dataset.production.plan import ShardJob, light_of, split_of, versions
from generator.dataset.production.records import (
    Details,
    ImageRecord,
    ShardRecord,
    Skipped,
    SourceRecord,
)
from generator.dataset.production.workers import SILENT, Callbacks
from generator.dataset.production.workplace import Workplace
from generator.lights.lighting import Lighting
from generator.pictures.picture import Cut, keep_bits
from generator.pictures.sources import Source
from generator.stores.store import Pieces

if TYPE_CHECKING:
    from calibration.table.lut import Lut

LARGEST_COUNT: Final = 65535
"""Largest value of 16 bits."""


@dataclass(frozen=True)
class _ReadSource:
    """The crops of a source, or all of it, and what is recorded of it.

    Where sRGB codes are those of the print, they are codes that the table has samples of.
    """

    cuts: tuple[Cut, ...]
    record: SourceRecord
    black_taken: float | None


class ShardCancelled(Exception):
    """A shard was given up because something else failed; whoever caused it handles it."""


def make_shard(
    job: ShardJob,
    lut: Lut,
    place: Workplace,
    pool: ThreadPoolExecutor,
    workers: int,
    callbacks: Callbacks = SILENT,
    cancelled: threading.Event | None = None,
) -> ShardRecord:
    """Make a shard and commit its record."""
    sources: list[SourceRecord] = []
    skipped: list[Skipped] = []
    images: list[ImageRecord] = []
    used: set[int] = set()
    pending: deque[Future[Sample]] = deque()
    reading: deque[Future[_ReadSource]] = deque()

    def finish_one(writer: ShardWriter) -> None:
        sample = pending.popleft().result()
        writer.append(sample)
        images.append(sample.record)
        callbacks.on_image()

    with _writer_of(job, place) as writer, _cancelling(pending, reading):
        for row, source in enumerate(job.sources):
            while len(reading) <= workers and row + len(reading) < len(job.sources):
                reading.append(pool.submit(_read, job, lut, row + len(reading)))
            try:
                read = reading.popleft().result()
            except FormatError as error:
                skipped.append(Skipped(position=job.position + row, name=source.name))
                callbacks.on_skip(source.name, str(error), len(_wanted(job, job.position + row)))
                continue
            sources.append(read.record)
            for number, crop, lighting in _wanted(job, job.position + row):
                while len(pending) >= 2 * workers:
                    finish_one(writer)
                if cancelled is not None and cancelled.is_set():
                    raise ShardCancelled
                used.update(light for mixture in lighting.mixtures for light in mixture.lights)
                pending.append(pool.submit(_make, job, lut, writer, number, read, crop, lighting))
        while pending:
            finish_one(writer)
        files = writer.close()
    record = ShardRecord(
        shard=job.shard,
        sources=sources,
        skipped=skipped,
        images=images,
        files=files,
        lights=[light_of(lut, light) for light in sorted(used)],
    )
    place.commit(record)
    return record


def _writer_of(job: ShardJob, place: Workplace) -> ShardWriter:
    options = job.options
    lightings = job.choice.lightings_of(job.position * options.crops)
    maps = options.variation.tints or any(lighting.masks is not None for lighting in lightings)
    return open_writer(
        options.layout, place.files, job.shard, previews=options.previews, maps=maps, details=options.has_details
    )


@contextmanager
def _cancelling(*queues: deque[Future[Any]]) -> Generator[None]:
    """Cancel what still waits for a thread if the block fails."""
    try:
        yield
    except BaseException:
        for queue in queues:
            for future in queue:
                future.cancel()
        raise


@dataclass(frozen=True)
class ShardDone:
    """Result of a task: how many images its shard has, and of each source that cannot be read name, reason, images."""

    images: int
    skipped: tuple[tuple[str, str, int], ...]


def make_elsewhere(job: ShardJob, place: Workplace) -> ShardDone:
    """Make a shard in a program of its own, which opens the table itself: the task of an engine's worker.

    A shard that is done already is not made again.
    """
    if place.has(job.shard):
        return ShardDone(len(place.load(job.shard).images), ())
    found = versions(job.options.form, job.options.layout)
    if found != job.versions:
        differing = [name for name in job.versions if found.get(name) != job.versions[name]]
        raise InputError(
            "a worker has other libraries than the plan was made with: "
            + ", ".join(f"{name} {found.get(name)} for {job.versions[name]}" for name in differing)
            + "; install the same on every machine"
        )
    skipped: list[tuple[str, str, int]] = []

    def skip(name: str, reason: str, images: int) -> None:
        skipped.append((name, reason, images))

    lut = _table(job.table, job.table_sha256)
    with ThreadPoolExecutor(1) as pool:
        record = make_shard(job, lut, place, pool, 1, Callbacks(on_skip=skip))
    return ShardDone(len(record.images), tuple(skipped))


@lru_cache(maxsize=2)
def _table(folder: Path, sha256: str) -> Lut:
    from calibration.table.lut import open_lut

    lut = open_lut(folder)
    if lut.sha256 != sha256:
        raise InputError(
            f"the table {folder} of a worker is not that of the plan; give every machine the same table at that path"
        )
    return lut


def _wanted(job: ShardJob, position: int) -> list[tuple[int, int, Lighting]]:
    """Return number, crop and lighting of each image of the source at `position` that is in the shard."""
    crops, each = job.options.crops, job.choice.lights_each
    numbered = (
        ((position * crops + crop) * each + place, crop, lighting)
        for crop in range(crops)
        for place, lighting in enumerate(job.choice.lightings_of(position * crops + crop))
    )
    return [wanted for wanted in numbered if job.first <= wanted[0] < job.stop]


def _read(job: ShardJob, lut: Lut, place: int) -> _ReadSource:
    from generator.files import smallest_side
    from generator.kernels.choice import replace_unfit_colours

    source: Source = job.sources[place]
    scene = source.read()
    whole = (Cut(0, 0, scene.picture),) if job.options.crops == 1 else scene.cuts
    if len(whole) != job.options.crops:
        raise InputError(
            f"{source.name} has {max(1, len(whole))} crops, expected {job.options.crops}; give the preparation of "
            "pictures and the options of the dataset the same number, and leave random scenes out"
        )
    whole = tuple(replace(cut, picture=keep_bits(cut.picture, job.options.bits)) for cut in whole)
    if job.options.rendering == "codes":
        fit = [replace_unfit_colours(cut.picture, lut.provenance) for cut in whole]
    else:
        # Mixtures of cells hold fit ones alone.
        fit = [(cut.picture, 0) for cut in whole]
    height, width = scene.picture.shape[:2]
    least = smallest_side(job.options.form)
    if min(height, width) < least:
        raise FormatError(
            f"{source.name} is {width}x{height} px, too small for {job.options.form}, which takes {least}x{least} and "
            "more; choose another format, or leave it out"
        )
    record = SourceRecord(
        position=job.position + place,
        name=source.name,
        sha256=scene.sha256,
        profile=scene.profile,
        width=width,
        height=height,
        replaced_pixels=sum(replaced for _, replaced in fit),
        split=job.parts[place] if job.parts else split_of(job.options.split, job.seed, scene.sha256, source.name),
        weight=scene.weight,
    )
    cuts = tuple(replace(cut, picture=picture) for cut, (picture, _) in zip(whole, fit, strict=True))
    return _ReadSource(cuts, record, scene.black_taken)


def _make(
    job: ShardJob, lut: Lut, writer: ShardWriter, number: int, source: _ReadSource, crop: int, lighting: Lighting
) -> Sample:
    from generator.files import (
        FULL,
        ImageMetadata,
        encode_pieces,
        encode_preview,
        suffix_of,
        to_full_scale,
    )
    from generator.pictures.preview import preview_of

    options, cut = job.options, source.cuts[crop]
    height, width = cut.picture.shape[:2]
    white_level = lut.provenance.white_level
    # What exceeds saturation may be below it once it is exposed anew, and is cut then.
    most = LARGEST_COUNT if options.variation.is_on else white_level
    taken = source.black_taken
    image, weights, rendered = photograph(lut, cut.picture, lighting, options, job.seed, number, most, taken)
    varied = options.variation.apply(image, white_level, job.seed, number)
    light = image_light(lut, lighting, weights, varied, options.variation.tints)
    stored, level = (image, white_level) if options.scale == "table" else (to_full_scale(image, white_level), FULL)
    metadata = ImageMetadata(level, light.truth, lut.provenance.camera)
    files: list[tuple[str, str, Pieces]] = [
        ("images", suffix_of(options.form), encode_pieces(stored, options.form, metadata)),
        *((kind, ending, (data,)) for kind, ending, data in light.maps),
    ]
    if options.previews:
        files.append(("previews", ".jpg", (encode_preview(preview_of(image, white_level)),)))
    details: Details = {"crop": crop, "left": cut.left, "top": cut.top} if options.crops > 1 else {}
    if source.record.weight is not None:
        details["weight"] = source.record.weight
    record = ImageRecord(
        number=number,
        position=source.record.position,
        truth=light.truth,
        lights=light.rows,
        details=details | rendered | varied.details,
    )
    return writer.store(Sample(record, source.record.name, source.record.split, width, height, tuple(files)))
