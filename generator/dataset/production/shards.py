"""One shard, from its sources to the record that says it is done.

Laws that hold inside:

- A shard's bytes depend on its job alone: not on the workers, on other shards, or on how often it is made.
- Its record is written last, when all else has been settled: a shard with a record is whole. It may be killed at any
  instruction, and any number of programs may make it at once.
- At most about three pictures are in memory for each worker.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable, Generator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from foundation.errors import FormatError, InputError
from generator.dataset.production.layouts import Sample, ShardWriter, open_writer
from generator.dataset.production.plan import ShardJob, light_of, split_of, versions
from generator.dataset.production.records import (
    ImageRecord,
    LightRow,
    ShardRecord,
    Skipped,
    SourceRecord,
    Triple,
)
from generator.dataset.production.workplace import Workplace
from generator.dataset.store import Pieces
from generator.lights.lighting import Lighting
from generator.pictures.picture import Picture
from generator.pictures.sources import Source

if TYPE_CHECKING:
    from calibration.table.lut import Lut

_threads = threading.local()

OnImage = Callable[[], None]
OnSkip = Callable[[str, str, int], None]
"""Takes the name of a source that cannot be read, the reason, and how many images there will not be."""


@dataclass(frozen=True)
class _Read:
    picture: Picture
    record: SourceRecord


class Stopped(Exception):
    """The work was given up because something else failed."""


def make_shard(
    job: ShardJob,
    lut: Lut,
    place: Workplace,
    pool: ThreadPoolExecutor,
    workers: int,
    on_image: OnImage | None = None,
    on_skip: OnSkip | None = None,
    stop: threading.Event | None = None,
) -> ShardRecord:
    """Make a shard and commit it.

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
    on_image, on_skip
        Called after each image, and for each source that cannot be read, from the calling thread.
    stop
        When set, the work is given up.

    Raises
    ------
    StorageError
        The disk is full, read-only or gone.
    Stopped
        `stop` was set.
    """
    sources: list[SourceRecord] = []
    skipped: list[Skipped] = []
    images: list[ImageRecord] = []
    used: set[int] = set()
    pending: deque[Future[Sample]] = deque()
    ahead: deque[Future[_Read]] = deque()

    def finish_one(writer: ShardWriter) -> None:
        sample = pending.popleft().result()
        writer.append(sample)
        images.append(sample.record)
        if on_image:
            on_image()

    with open_writer(job, place.files) as writer, _cancelling(pending, ahead):
        for row, source in enumerate(job.sources):
            while len(ahead) <= workers and row + len(ahead) < len(job.sources):
                ahead.append(pool.submit(_read, job, lut, row + len(ahead)))
            try:
                got = ahead.popleft().result()
            except FormatError as error:
                skipped.append(Skipped(position=job.position + row, name=source.name))
                if on_skip:
                    on_skip(source.name, str(error), len(_wanted(job, job.position + row)))
                continue
            sources.append(got.record)
            for number, lighting in _wanted(job, job.position + row):
                while len(pending) >= 2 * workers:
                    finish_one(writer)
                if stop is not None and stop.is_set():
                    raise Stopped
                used.update(light for mixture in lighting.mixtures for light in mixture.lights)
                pending.append(pool.submit(_make, job, lut, writer, number, got, lighting))
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


@contextmanager
def _cancelling(*queues: deque[Future[Any]]) -> Generator[None]:
    """Take back what waits for a thread if the block fails."""
    try:
        yield
    except BaseException:
        for queue in queues:
            for future in queue:
                future.cancel()
        raise


@dataclass(frozen=True)
class Done:
    """What a task tells when its shard is done: how many images, and of `OnSkip` what could not be read."""

    images: int
    skipped: tuple[tuple[str, str, int], ...]


def make_elsewhere(job: ShardJob, place: Workplace) -> Done:
    """Make a shard in a program of its own, with the table as that program finds it: the task of an engine.

    A shard that is done already is not made again.

    Raises
    ------
    InputError
        The table or a library is not that of the plan.
    """
    if place.has(job.shard):
        return Done(len(place.load(job.shard).images), ())
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
        record = make_shard(job, lut, place, pool, 1, on_skip=skip)
    return Done(len(record.images), tuple(skipped))


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


def _read(job: ShardJob, lut: Lut, place: int) -> _Read:
    from generator.files.formats import smallest_side
    from generator.kernels.palette import fit_picture

    source: Source = job.sources[place]
    scene = source.read()
    picture, replaced = fit_picture(scene.picture, lut.provenance)
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
    return _Read(picture, record)


def _make(job: ShardJob, lut: Lut, writer: ShardWriter, number: int, got: _Read, lighting: Lighting) -> Sample:
    from generator.files.formats import Shot, encode_pieces, encode_preview, suffix_of
    from generator.pictures.preview import preview_of

    height, width = got.picture.shape[:2]
    white_level = lut.provenance.white_level
    image, truth, maps = _photograph(lut, got.picture, lighting, job.seed, number)
    shot = Shot(white_level, truth, lut.provenance.camera)
    files: list[tuple[str, str, Pieces]] = [
        ("images", suffix_of(job.options.form), encode_pieces(image, job.options.form, shot)),
        *((kind, ending, (data,)) for kind, ending, data in maps),
    ]
    if job.options.previews:
        files.append(("previews", ".jpg", (encode_preview(preview_of(image, white_level)),)))
    rows = [
        LightRow(illumination=mixture.label, truth=chromaticity(mixture.white(lut))) for mixture in lighting.mixtures
    ]
    record = ImageRecord(number=number, position=got.record.position, truth=truth, lights=rows)
    return writer.store(Sample(record, got.record.name, got.record.split, width, height, tuple(files)))


def _photograph(
    lut: Lut, picture: Picture, lighting: Lighting, seed: int, number: int
) -> tuple[npt.NDArray[np.uint16], Triple, list[tuple[str, str, bytes]]]:
    """Return the raw image, the mean of its lights, and the files that say where each of several lights falls."""
    from generator.kernels.mixing import mix_samples
    from generator.kernels.rendering import draw_samples
    from generator.masks.files import encode_maps

    # The hash of the table stands for its samples in the dataset's description.
    for mixture in lighting.mixtures:
        for light in mixture.lights:
            lut.require_unchanged(light)
    tables = [mixture.samples(lut, seed, picture) for mixture in lighting.mixtures]
    if lighting.masks is None:
        image = draw_samples(tables[0], picture, seed=seed, image=number, out=_room(picture.shape))
        return image, chromaticity(lighting.whites(lut)[0]), []
    weights = lighting.weights_of(*picture.shape[:2])
    white_level = lut.provenance.white_level
    image = mix_samples(tables, picture, weights, white_level=white_level, seed=seed, image=number)
    return image, chromaticity(lighting.overall(lut, weights)), encode_maps(lut, lighting, weights)


def _room(shape: tuple[int, ...]) -> npt.NDArray[np.uint16]:
    """Return an array that the calling thread has again and again: fresh pages take as long as drawing into them."""
    size = math.prod(shape)
    room: npt.NDArray[np.uint16] | None = getattr(_threads, "room", None)
    if room is None or room.size < size:
        _threads.room = room = np.empty(size, np.uint16)
    return room[:size].reshape(shape)


def chromaticity(white: npt.NDArray[np.float64]) -> Triple:
    """Return (r, g, b) of sum 1 of linear RGB (3,)."""
    red, green, blue = (float(part) for part in white / white.sum())
    return red, green, blue
