"""One shard, from its sources to the record that says it is done.

Rules that hold inside:

- A shard's bytes depend on its job alone: not on the workers, on other shards, or on how often it is made.
- Its record is written last, when all else has been synchronised with the disk: a shard with a record is whole. The
  program may be killed at any instruction, and any number of programs may make the same shard at once.
- At most about three pictures are in memory for each worker.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Generator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from foundation.errors import FormatError, InputError
from generator.dataset.production.layouts.by_name import open_writer
from generator.dataset.production.layouts.samples import Sample, ShardWriter
from generator.dataset.production.plan import ShardJob, light_of, split_of, versions
from generator.dataset.production.records import (
    ImageRecord,
    LightRow,
    ShardRecord,
    Skipped,
    SourceRecord,
    Triple,
)
from generator.dataset.production.workers import SILENT, Callbacks
from generator.dataset.production.workplace import Workplace
from generator.lights.lighting import Lighting
from generator.pictures.picture import Picture
from generator.pictures.sources import Source
from generator.stores.store import Pieces

if TYPE_CHECKING:
    from calibration.table.lut import Lut

_threads = threading.local()


@dataclass(frozen=True)
class _ReadSource:
    """A source picture (H, W, 3) uint8, sRGB codes that the table has samples of, and what is recorded of it."""

    picture: Picture
    record: SourceRecord


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
    """Make a shard and commit its record.

    Parameters
    ----------
    job
        What to make.
    lut
        The table.
    place
        Where the dataset is being made.
    pool, workers
        Threads that read, render, encode and write, and how many pieces of work to keep them busy with.
    callbacks
        What is called after each image and for each source that cannot be read, from the calling thread.
    cancelled
        When set, the shard is given up.

    Raises
    ------
    StorageError
        The disk is full, read-only or gone.
    ShardCancelled
        `cancelled` was set.
    """
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
            for number, lighting in _wanted(job, job.position + row):
                while len(pending) >= 2 * workers:
                    finish_one(writer)
                if cancelled is not None and cancelled.is_set():
                    raise ShardCancelled
                used.update(light for mixture in lighting.mixtures for light in mixture.lights)
                pending.append(pool.submit(_make, job, lut, writer, number, read, lighting))
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
    maps = any(lighting.masks is not None for lighting in job.choice.lightings_of(job.position))
    options = job.options
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

    Raises
    ------
    InputError
        The table or a library is not that of the plan.
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


def _wanted(job: ShardJob, position: int) -> list[tuple[int, Lighting]]:
    """Return number and lighting of each image of the source at `position` that is in the shard."""
    lightings = job.choice.lightings_of(position)
    first = position * job.choice.lights_each
    numbered = ((first + place, lighting) for place, lighting in enumerate(lightings))
    return [(number, lighting) for number, lighting in numbered if job.first <= number < job.stop]


def _read(job: ShardJob, lut: Lut, place: int) -> _ReadSource:
    from generator.files.formats import smallest_side
    from generator.kernels.palette import replace_unfit_colours

    source: Source = job.sources[place]
    scene = source.read()
    picture, replaced = replace_unfit_colours(scene.picture, lut.provenance)
    height, width = picture.shape[:2]
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
        replaced_pixels=replaced,
        split=split_of(job.options.split, job.seed, scene.sha256, source.name),
    )
    return _ReadSource(picture, record)


def _make(job: ShardJob, lut: Lut, writer: ShardWriter, number: int, source: _ReadSource, lighting: Lighting) -> Sample:
    from generator.files.formats import ImageMetadata, encode_pieces, encode_preview, suffix_of
    from generator.pictures.preview import preview_of

    height, width = source.picture.shape[:2]
    white_level = lut.provenance.white_level
    image, truth, maps = _photograph(lut, source.picture, lighting, job.seed, number)
    metadata = ImageMetadata(white_level, truth, lut.provenance.camera)
    files: list[tuple[str, str, Pieces]] = [
        ("images", suffix_of(job.options.form), encode_pieces(image, job.options.form, metadata)),
        *((kind, ending, (data,)) for kind, ending, data in maps),
    ]
    if job.options.previews:
        files.append(("previews", ".jpg", (encode_preview(preview_of(image, white_level)),)))
    rows = [
        LightRow(illumination=mixture.label, truth=chromaticity(mixture.white(lut))) for mixture in lighting.mixtures
    ]
    record = ImageRecord(number=number, position=source.record.position, truth=truth, lights=rows)
    return writer.store(Sample(record, source.record.name, source.record.split, width, height, tuple(files)))


def _photograph(
    lut: Lut, picture: Picture, lighting: Lighting, seed: int, number: int
) -> tuple[npt.NDArray[np.uint16], Triple, list[tuple[str, str, bytes]]]:
    """Return the raw image (H, W, 3) uint16, the mean chromaticity of its lights, and the maps of several lights."""
    from generator.kernels.mixing import mix_samples
    from generator.kernels.rendering import draw_samples
    from generator.masks.maps import encode_maps

    # The hash of the table stands for its samples in the dataset's description.
    for mixture in lighting.mixtures:
        for light in mixture.lights:
            lut.require_unchanged(light)
    tables = [mixture.samples(lut, seed, picture) for mixture in lighting.mixtures]
    if lighting.masks is None:
        image = draw_samples(tables[0], picture, seed=seed, image=number, out=_reused(picture.shape))
        return image, chromaticity(lighting.whites(lut)[0]), []
    weights = lighting.weights_of(*picture.shape[:2])
    white_level = lut.provenance.white_level
    image = mix_samples(tables, picture, weights, white_level=white_level, seed=seed, image=number)
    return image, chromaticity(lighting.overall(lut, weights)), encode_maps(weights, lighting.whites(lut))


def _reused(shape: tuple[int, ...]) -> npt.NDArray[np.uint16]:
    """Return an array uint16 of any content in memory of the calling thread, which its next call overwrites.

    Fresh pages take as long to map as the drawing into them.
    """
    size = math.prod(shape)
    memory: npt.NDArray[np.uint16] | None = getattr(_threads, "memory", None)
    if memory is None or memory.size < size:
        _threads.memory = memory = np.empty(size, np.uint16)
    return memory[:size].reshape(shape)


def chromaticity(white: npt.NDArray[np.float64]) -> Triple:
    """Return (r, g, b) of sum 1 of linear RGB (3,) float64."""
    red, green, blue = (float(part) for part in white / white.sum())
    return red, green, blue
