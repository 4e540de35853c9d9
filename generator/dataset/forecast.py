"""Forecast the size of a data set, the time it takes, and the colours outside the gamut of its print.

A random sample of its images is read, rendered and encoded in memory, in the threads that would make the data set.
"""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np

from foundation.errors import FormatError
from generator.dataset.plan import Plan, ShardJob
from generator.dataset.records import ImageRecord, RenderingSummary
from generator.dataset.shards import (
    NothingMadeError,
    ReadSource,
    RenderingSums,
    images_of_source,
    read_source,
    render_image,
)
from generator.lights.lighting import Lighting
from generator.stores import join_pieces

_SAMPLED: Final = 32  # Images that are rendered; their mean size then has a standard error of some percent
_READING_LIMIT_S: Final = 20.0  # No further pictures are read after this time; only very large ones need so long
_LISTED_BYTES: Final = 300  # Bytes for a file besides its content: its lines in the lists, or its head in a tar file
_TEXT_BYTES: Final = 20_000  # Bytes of description, card and datasheet


@dataclass(frozen=True)
class Forecast:
    """Forecast of a data set from a sample of its images."""

    images: int  # that can be made
    needed_bytes: int  # sum of the sizes of all files
    time_s: float  # without copying files to a store
    rendering: RenderingSummary
    sampled: int  # pictures that were read, or could not be read
    skipped: tuple[str, ...]  # reasons why pictures of the sample cannot be read


_Image = tuple[ShardJob, ReadSource, int, int, Lighting]  # job, picture, number of the image, crop, lighting


def forecast(plan: Plan, images: int, workers: int) -> Forecast:
    """Return the forecast for `images` images of a plan, with a number of threads; writes nothing."""
    pictures = len(plan.sources)
    positions = np.random.default_rng(0).permutation(pictures)[:_SAMPLED].tolist()
    images_each = -(-_SAMPLED // len(positions))
    sums, skipped = RenderingSums(), list[str]()
    read_count = rendered_count = size = 0
    read_s = render_s = 0.0

    def read(position: int) -> list[_Image] | str:
        try:
            return _images(plan, position, images_each)
        except FormatError as error:
            return str(error)

    # The first image also compiles functions and computes the map of the print, so it is rendered before time is taken.
    first_images = next((images for images in map(read, positions) if not isinstance(images, str)), None)
    if first_images is None:
        raise NothingMadeError(f"0 of {len(positions)} pictures can be used: {read(positions[0])}")
    _rendered(plan, first_images[0])
    with ThreadPoolExecutor(workers) as pool:
        for first in range(0, len(positions), workers):
            if read_s + render_s > _READING_LIMIT_S and rendered_count:
                break
            begin = time.monotonic()
            results = list(pool.map(read, positions[first : first + workers]))
            read_s += time.monotonic() - begin
            read_count += len(results)
            skipped += [result for result in results if isinstance(result, str)]
            chosen = [image for result in results if not isinstance(result, str) for image in result]
            begin = time.monotonic()
            for record, pixels, file_bytes in pool.map(partial(_rendered, plan), chosen):
                sums.add(record.details, pixels)
                size += file_bytes
            render_s += time.monotonic() - begin
            rendered_count += len(chosen)
    made = round(images * (1 - len(skipped) / read_count))
    return Forecast(
        images=made,
        needed_bytes=round(made * size / rendered_count) + _TEXT_BYTES,
        time_s=images / plan.images_each * read_s / read_count + made * render_s / rendered_count,
        rendering=sums.summary(),
        sampled=read_count,
        skipped=tuple(skipped),
    )


def _rendered(plan: Plan, image: _Image) -> tuple[ImageRecord, int, int]:
    # Record, pixels and bytes of an image.
    job, source, number, crop, lighting = image
    sample = render_image(job, plan.lut, number, source, crop, lighting)
    size = sum(_LISTED_BYTES + len(join_pieces(pieces)) for _, _, pieces in sample.files)
    return sample.record, sample.width * sample.height, size


def _images(plan: Plan, position: int, count: int) -> list[_Image]:
    first = position * plan.images_each
    # A job of the images of this picture.
    job = replace(
        plan.job(0),
        position=position,
        first=first,
        stop=first + plan.images_each,
        sources=(plan.sources[position],),
    )
    source, numbered = read_source(job, plan.lut, 0, {}), images_of_source(job, position)
    chosen = np.random.default_rng(position).permutation(len(numbered))[:count]
    return [(job, source, *numbered[index]) for index in chosen]
