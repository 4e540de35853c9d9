"""Make the shards of a data set, and assemble the data set from them.

A `Workplace` is the location where a data set is made; interrupted work is resumed there. On a disk it is the hidden
folder `.OUT.partial`. Its subfolder `dataset-ID/` has the files, where ID is the identifier of the plan. `plan/` has
the plan and a file of finished pieces for each shard (`foundation.pieces`). At the end `dataset-ID/` is renamed to
OUT. An object store has no rename: files are written to their final location, plan and records below `OUT/.plan/`, and
`dataset.json` is written last. Contract:

- The bytes of a shard depend only on its job: not on workers, other shards, or repeated work.
- A shard is complete exactly if its piece exists, because the piece is written after all files are on the disk. The
  program may be killed at any time, and several programs may make the same shard at once.
- Each image of an incomplete shard is a piece too. When the shard is resumed, an image is reused if its files and its
  source still have the recorded hashes. Object stores cannot append to files and have no such pieces.
- Each worker keeps about three pictures in memory.

An image with one illuminant has the ground truth of this illuminant, also with a fall-off of brightness. With a
coloured fall-off (`generator.variation.variation`), the illuminant is listed twice, for both ends of the fall-off.
Masks then have the weights of both ends in each pixel.
"""

from __future__ import annotations

import hashlib
import math
import shutil
import threading
from collections import Counter, deque
from collections.abc import Callable, Container, Generator, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, Final, TypeVar

import numpy as np
import numpy.typing as npt

from calibration.table.lut import open_lut
from foundation.compiled import ordered_map
from foundation.errors import FormatError, InputError
from foundation.files import HashingWriter, csv_text
from foundation.folders import publish_folder, require_free
from foundation.pieces import Piece, read_pieces
from foundation.records import from_json
from foundation.version import software
from generator.dataset.cards import card, datasheet
from generator.dataset.joined import Extras
from generator.dataset.layouts import LAYOUTS, FileLayout, ShardWriter
from generator.dataset.plan import DatasetOptions, ShardJob, versions
from generator.dataset.reader import Dataset, load_description
from generator.dataset.records import (
    CARD,
    COMPLETED_BY_HAND,
    DATASHEET,
    GROUND_TRUTH,
    GROUND_TRUTH_COLUMNS,
    IMAGES,
    NAMED_TRUTHS,
    SOURCE_COLUMNS,
    SOURCES,
    SPLITS,
    SUMS,
    TRUTHS,
    UNCERTAINTY_COLUMN,
    Description,
    Details,
    FileSum,
    FinishedImage,
    ImageRecord,
    Light,
    LightRow,
    RenderingSummary,
    Sample,
    ShardRecord,
    Skipped,
    SourceRecord,
    Split,
    TableRecord,
    Triple,
    image_key,
    shard_key,
)
from generator.files import FILE_FORMATS, FULL, ImageMetadata, encode_pieces, encode_preview, preview_of, suffix_of
from generator.kernels.mixing import mix_samples
from generator.kernels.printing import count_by_node
from generator.kernels.rendering import WHOLE_LIGHT_PIXELS, draw_samples
from generator.kernels.unfit import colours_in, replace_unfit_colours
from generator.lights.lighting import Lighting, Mixture
from generator.masks.maps import encode_maps, mean_weights
from generator.pictures.sources import Cut, Picture, Source, changed_sha256
from generator.rendering.black_points import black_subtraction, subtract_black
from generator.rendering.colorimetric import rendering_with
from generator.rendering.matrices import dng_matrices, matrix_for
from generator.stores import DESCRIPTION, LocalStore, Pieces, Store, open_store
from generator.variation.variation import AppliedVariation

if TYPE_CHECKING:
    from calibration.table.lut import Lut


PLAN: Final = "plan.json"
RECORDS: Final = "shards"  # Folder of the records of shards
NOTES: Final = ".plan"  # Folder of plan and records in an object store
_SHARD_PIECE: Final = "shard"  # Name of the piece of a complete shard; pieces of images have their numbers as names
_HEAD_BYTES: Final = 80  # Number of bytes at the start of a record file that contain the name of its first piece
_READERS: Final = 16  # Number of record files read in parallel, because a read mostly waits for the store

PlanIdentity = Mapping[str, Any]

_threads: Final = threading.local()

# Shorter side in px below which a picture gets a note: probably an icon or a failed download, not a photograph.
TINY_PX: Final = 16

_HASH_VALUES: Final = 1 << 64  # Number of values of eight bytes: the first eight bytes of a hash select the split


def split_of(shares: tuple[float, float, float] | None, seed: int, sha256: str | None, name: str) -> Split | None:
    """Return the split of a source; `shares` of train, validation and test have the sum 1."""
    # The split depends only on the seed and on the content of the source (the name, if there is no file). Copies of a
    # file are therefore in the same split, and the shares are exact only on average.
    if shares is None:
        return None
    digest = hashlib.sha256(f"split {seed} {sha256 or name}".encode()).digest()[:8]
    position = int.from_bytes(digest, "big") / _HASH_VALUES
    bound = 0.0
    for split, share in zip(SPLITS, shares, strict=True):
        bound += share
        if position < bound and share:
            return split
    return max(zip(shares, SPLITS, strict=True))[1]


def light_of(lut: Lut, light: int) -> Light:
    """Return the record of an illuminant of the LUT."""
    illumination, expanded = lut.illuminations[light], lut.truth_uncertainty_deg
    red, green, blue = (float(channel) for channel in lut.white[light])
    return Light(
        illumination=light,
        kind=illumination.kind,
        cct_k=illumination.cct_k,
        codes=illumination.colour,
        white=(red, green, blue),
        name=illumination.name,
        uncertainty_deg=None if expanded is None else float(f"{expanded[light]:.4g}"),
    )


@dataclass(frozen=True)
class PrintColours:
    """Colour reproduction of the print of a picture; columns of `images.csv`."""

    cells: str  # first 16 digits of the SHA-256 of the map of the print
    outside: float  # share of the pixels with colours that the print cannot show, 0 … 1
    distance: float  # mean colour error, degrees


@dataclass(frozen=True, eq=False)
class RawImage:
    """The raw image of a print."""

    counts: npt.NDArray[np.uint16]  # (H, W, 3), linear camera RGB; may be overwritten by the next call in this thread
    weights: npt.NDArray[np.float32] | None  # (H, W, K), masks of several illuminants; None for one
    black_taken: float | None = None  # subtracted share of the black of the print, 0 … 1; None if it is kept
    print_colours: PrintColours | None = None

    def details(self) -> Details:
        """Return the columns of `images.csv`."""
        columns: Details = {} if self.print_colours is None else dict(vars(self.print_colours))
        return columns if self.black_taken is None else columns | {"black_taken": self.black_taken}


def photograph(
    lut: Lut,
    picture: Picture,
    lighting: Lighting,
    options: DatasetOptions,
    seed: int,
    number: int,
    white_level: int,
) -> RawImage:
    """Return the raw image of a print of `picture` (H, W, 3) uint8, sRGB codes.

    For rendering by codes, all colours must have samples in the LUT. `number` is the number of the image.
    `white_level` limits the counts of images with masks.
    """
    # The data set records the hash of the LUT, so the samples must still match the hashes in the LUT.
    for mixture in lighting.mixtures:
        for light in mixture.lights:
            lut.require_unchanged(light)
    share = None if options.black_point.kind == "keep" else options.black_point.share(seed, number)
    weights = None if lighting.masks is None else lighting.weights_of(*picture.shape[:2])
    if options.rendering == "colorimetric":
        rendering = rendering_with(lut, options.matrix or matrix_for(lut))
        outside, distance = rendering.map.gamut_error(count_by_node(picture))
        counts = rendering.draw(
            picture,
            lighting.mixtures,
            share or 0.0,
            weights,
            white_level=lut.provenance.white_level if weights is None else white_level,
            seed=seed,
            image=number,
            out=_reused(picture.shape),
        )
        print_colours = PrintColours(rendering.map.sha256[:16], round(outside, 6), round(distance, 6))
        return RawImage(counts, weights, share, print_colours)
    tables = [_samples(lut, mixture, picture, share or 0.0, seed) for mixture in lighting.mixtures]
    if weights is None:
        counts = draw_samples(tables[0], picture, seed=seed, image=number, out=_reused(picture.shape))
    else:
        counts = mix_samples(tables, picture, weights, white_level=white_level, seed=seed, image=number)
    return RawImage(counts, weights, share)


def _samples(lut: Lut, mixture: Mixture, picture: Picture, share: float, seed: int) -> npt.NDArray[np.uint16]:
    # Samples minus a share of the black of the print; samples of colours that the picture lacks may be unchanged.
    samples = mixture.samples(lut, seed, picture)
    if not share:
        return samples
    colours = colours_in(picture, lut.provenance.bits) if picture.size < 3 * WHOLE_LIGHT_PIXELS else None
    black = black_subtraction(lut, mixture, share)
    return subtract_black(samples, black, lut.provenance.white_level, colours)


def _reused(shape: tuple[int, ...]) -> npt.NDArray[np.uint16]:
    # Uninitialised memory of the calling thread, overwritten by its next call. Mapping new pages would take as long as
    # rendering into them.
    size = math.prod(shape)
    memory: npt.NDArray[np.uint16] | None = getattr(_threads, "memory", None)
    if memory is None or memory.size < size:
        _threads.memory = memory = np.empty(size, np.uint16)
    return memory[:size].reshape(shape)


@dataclass(frozen=True, eq=False)
class _ImageLight:
    """Ground truth and maps of one image."""

    truth: Triple  # mean over all pixels, sum 1
    rows: list[LightRow]
    maps: list[tuple[str, str, bytes]]  # file kind, end of the file name, bytes


def _image_light(
    lut: Lut, lighting: Lighting, weights: npt.NDArray[np.float32] | None, varied: AppliedVariation, tints: bool
) -> _ImageLight:
    labels = [mixture.label for mixture in lighting.mixtures]
    whites = lighting.whites(lut)
    intensity = None
    if tints:
        weights, labels = varied.weights, labels * 2
        whites = np.concatenate([whites, whites * np.array(varied.end)])
    elif weights is not None:
        intensity = varied.intensity()
    rows = [
        LightRow(illumination=label, truth=chromaticity(white)) for label, white in zip(labels, whites, strict=True)
    ]
    if weights is None:
        return _ImageLight(rows[0].truth, rows, [])
    reaching = weights if intensity is None else weights * intensity[..., None]
    truth = chromaticity(np.asarray(mean_weights(reaching) @ whites))
    return _ImageLight(truth, rows, encode_maps(weights, whites))


def chromaticity(white: npt.NDArray[np.float64]) -> Triple:
    """Return (r, g, b) with the sum 1 of linear RGB (3,) float64."""
    red, green, blue = (float(channel) for channel in white / white.sum())
    return red, green, blue


def _ignore(*arguments: object) -> None:
    del arguments


@dataclass(frozen=True)
class Callbacks:
    """Functions that are called while images are generated, always from the calling thread.

    Attributes
    ----------
    on_done
        Called with a number of images that are reused from an earlier run. It is negative if the source of reused
        images has changed, so that they are made again.
    on_image
        Called after each image.
    on_skip
        Called with the name of a source that cannot be read, the reason, and the number of its images.
    on_wait
        Called with a message when the work waits for an action of the user.

    Examples
    --------
    >>> skipped = []
    >>> callbacks = Callbacks(on_skip=lambda name, reason, images: skipped.append(name))
    >>> callbacks.on_skip("bad.png", "bad.png is not a picture", 2)
    >>> skipped
    ['bad.png']
    """

    on_done: Callable[[int], None] = _ignore
    on_image: Callable[[], None] = _ignore
    on_skip: Callable[[str, str, int], None] = _ignore
    on_wait: Callable[[str], None] = _ignore


SILENT: Final = Callbacks()  # Callbacks that do nothing


@dataclass(frozen=True)
class ReadSource:
    """A source picture that was read."""

    cuts: tuple[Cut, ...]  # its crops, or the full picture as one crop; empty if all its images are finished
    record: SourceRecord


class ShardCancelled(Exception):
    """A shard was cancelled because of an error in another shard, which is reported there."""


def make_shard(
    job: ShardJob,
    lut: Lut,
    workplace: Workplace,
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
    reading: deque[Future[ReadSource]] = deque()
    finished = _finished_images(job, workplace, pool)
    if finished:
        callbacks.on_done(len(finished))

    def finish_one(writer: ShardWriter) -> None:
        sample = pending.popleft().result()
        writer.append(sample)
        images.append(sample.record)
        if sample.record.number not in finished:
            callbacks.on_image()

    def forget_changed(shard_images: list[tuple[int, int, Lighting]], source: SourceRecord | None) -> None:
        changed = [number for number, _, _ in shard_images if number in finished and finished[number].source != source]
        for number in changed:
            del finished[number]
        if changed:
            callbacks.on_done(-len(changed))

    with _writer_of(job, lut, workplace) as writer, _cancelling(pending, reading):
        for row, source in enumerate(job.sources):
            while len(reading) <= workers and row + len(reading) < len(job.sources):
                reading.append(pool.submit(read_source, job, lut, row + len(reading), finished))
            shard_images = images_of_source(job, job.position + row)
            try:
                read = reading.popleft().result()
            except FormatError as error:
                forget_changed(shard_images, None)
                skipped.append(Skipped(position=job.position + row, name=source.name))
                callbacks.on_skip(source.name, str(error), len(shard_images))
                continue
            forget_changed(shard_images, read.record)
            sources.append(read.record)
            for number, crop, lighting in shard_images:
                while len(pending) >= 2 * workers:
                    finish_one(writer)
                if cancelled is not None and cancelled.is_set():
                    raise ShardCancelled
                used.update(light for mixture in lighting.mixtures for light in mixture.lights)
                if number in finished:
                    pending.append(pool.submit(_reused_sample, finished[number]))
                else:
                    pending.append(pool.submit(_write, job, lut, workplace, writer, number, read, crop, lighting))
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
    workplace.commit(record)
    return record


def _finished_images(job: ShardJob, workplace: Workplace, pool: ThreadPoolExecutor) -> dict[int, FinishedImage]:
    # Another program may have committed the complete shard in the meantime.
    pieces = [piece for name, piece in workplace.pieces(job.shard).items() if name != _SHARD_PIECE]
    return {image.image.number: image for image in pool.map(workplace.image_of, pieces) if image is not None}


def _reused_sample(image: FinishedImage) -> Sample:
    source = image.source
    return Sample(image.image, source.name, source.split, source.width, source.height, (), tuple(image.files))


def _writer_of(job: ShardJob, lut: Lut, workplace: Workplace) -> ShardWriter:
    options = job.options
    lightings = job.choice.lightings_of(job.position * options.crops)
    maps = options.tints or any(lighting.masks is not None for lighting in lightings)
    camera = lut.provenance.camera
    layout = LAYOUTS[options.layout]
    has_metadata = isinstance(layout, FileLayout) and layout.metadata is not None
    matrices = dng_matrices(lut) if has_metadata else None
    return layout.open_writer(
        workplace.files, job.shard, Extras(options.previews, maps, options.has_details, camera, matrices)
    )


@contextmanager
def _cancelling(*queues: deque[Future[Any]]) -> Generator[None]:
    try:
        yield
    except BaseException:
        for queue in queues:
            for future in queue:
                future.cancel()
        raise


@dataclass(frozen=True)
class ShardDone:
    """Result of a task of a worker."""

    images: int  # of the shard
    skipped: tuple[tuple[str, str, int], ...]  # sources that cannot be read: name, reason, number of images
    reused: int = 0  # images that an earlier run had finished


def make_shard_on_worker(job: ShardJob, workplace: Workplace) -> ShardDone:
    """Make a shard in a worker process, which opens the LUT itself, unless the shard is complete."""
    if workplace.has(job.shard):
        return ShardDone(len(workplace.load(job.shard).images), ())
    installed = versions(job.options.form, job.options.layout)
    if installed != job.versions:
        differing = [name for name in job.versions if installed.get(name) != job.versions[name]]
        raise InputError(
            "a worker has different versions of libraries than the plan: "
            + ", ".join(f"{name} {installed.get(name)}, expected {job.versions[name]}" for name in differing)
            + "; install equal versions on all machines"
        )
    skipped: list[tuple[str, str, int]] = []
    reused_counts: list[int] = []

    def skip(name: str, reason: str, images: int) -> None:
        skipped.append((name, reason, images))

    lut = _planned_lut(job.table, job.table_sha256)
    with ThreadPoolExecutor(1) as pool:
        record = make_shard(job, lut, workplace, pool, 1, Callbacks(on_done=reused_counts.append, on_skip=skip))
    return ShardDone(len(record.images), tuple(skipped), sum(reused_counts))


@lru_cache(maxsize=2)
def _planned_lut(folder: Path, sha256: str) -> Lut:
    lut = open_lut(folder)
    if lut.sha256 != sha256:
        raise InputError(
            f"the LUT {folder} of a worker has hash {lut.sha256}, expected {sha256}; copy the LUT to all machines"
        )
    return lut


def images_of_source(job: ShardJob, position: int) -> list[tuple[int, int, Lighting]]:
    """Return number, crop and lighting of each image of a source that is in the shard."""
    crops, lights_each = job.options.crops, job.choice.lights_each
    numbered_images = (
        ((position * crops + crop) * lights_each + light_index, crop, lighting)
        for crop in range(crops)
        for light_index, lighting in enumerate(job.choice.lightings_of(position * crops + crop))
    )
    return [numbered_image for numbered_image in numbered_images if job.first <= numbered_image[0] < job.stop]


def read_source(job: ShardJob, lut: Lut, row: int, finished: Mapping[int, FinishedImage]) -> ReadSource:
    """Read source `row` of a job, unless all its images are finished."""
    recorded = _unchanged_source(job, job.position + row, finished) if finished else None
    if recorded is not None:
        return ReadSource((), recorded)
    source: Source = job.sources[row]
    scene = source.read()
    source_cuts = (Cut(0, 0, scene.picture),) if job.options.crops == 1 else scene.cuts
    if len(source_cuts) != job.options.crops:
        raise InputError(
            f"{source.name} has {max(1, len(source_cuts))} crops, expected {job.options.crops}; use the "
            "same number of crops for the preparation and the data set, and omit random scenes"
        )
    if job.options.rendering == "codes":
        repaired = [replace_unfit_colours(cut.picture, lut.provenance) for cut in source_cuts]
    else:
        # Rendering by colour does not use unfit patches.
        repaired = [(cut.picture, 0) for cut in source_cuts]
    height, width = scene.picture.shape[:2]
    smallest_side = FILE_FORMATS[job.options.form].smallest_side
    if min(height, width) < smallest_side:
        raise FormatError(
            f"{source.name} is {width}x{height} px, expected {smallest_side}x{smallest_side} or more for "
            f"{job.options.form}; choose another format, or omit the picture"
        )
    notes = [*scene.notes]
    if min(height, width) < TINY_PX:
        notes.append(f"tiny, {width}x{height} px")
    if not all(cut.picture.any() for cut in source_cuts):
        notes.append("all black")
    record = SourceRecord(
        position=job.position + row,
        name=source.name,
        sha256=scene.sha256,
        profile=scene.profile or None,
        width=width,
        height=height,
        replaced_pixels=sum(replaced for _, replaced in repaired),
        split=split_of(job.options.split, job.seed, scene.sha256, source.name),
        note="; ".join(notes) or None,
    )
    cuts = tuple(replace(cut, picture=picture) for cut, (picture, _) in zip(source_cuts, repaired, strict=True))
    return ReadSource(cuts, record)


def _unchanged_source(job: ShardJob, position: int, finished: Mapping[int, FinishedImage]) -> SourceRecord | None:
    # The record of a source if all its images are finished and the source has not changed since; None in other cases.
    images = images_of_source(job, position)
    records = [finished[number].source if number in finished else None for number, _, _ in images]
    first = records[0] if records else None
    if first is None or any(source != first for source in records):
        return None
    # The hash of a file in a store is unknown until the file is read.
    return first if changed_sha256(job.sources[position - job.position], -math.inf) == first.sha256 else None


def _write(
    job: ShardJob,
    lut: Lut,
    workplace: Workplace,
    writer: ShardWriter,
    number: int,
    source: ReadSource,
    crop: int,
    lighting: Lighting,
) -> Sample:
    sample = writer.store(render_image(job, lut, number, source, crop, lighting))
    if sample.stored:
        finished = FinishedImage(image=sample.record, source=source.record, files=list(sample.stored))
        workplace.note(job.shard, finished)
    return sample


def render_image(job: ShardJob, lut: Lut, number: int, source: ReadSource, crop: int, lighting: Lighting) -> Sample:
    """Render an image. The pieces of its files are valid until this thread renders the next image."""
    options, cut = job.options, source.cuts[crop]
    height, width = cut.picture.shape[:2]
    white_level = lut.provenance.white_level
    # A variation may reduce the exposure, so values above saturation are kept and clipped afterwards.
    limit = white_level if options.variation is None else FULL
    raw = photograph(lut, cut.picture, lighting, options, job.seed, number, limit)
    varied = AppliedVariation()
    if options.variation is not None:
        varied = options.variation.apply(raw.counts, white_level, job.seed, number)
    light = _image_light(lut, lighting, raw.weights, varied, options.tints)
    metadata = ImageMetadata(white_level, light.truth, lut.provenance.camera)
    files: list[tuple[str, str, Pieces]] = [
        ("images", suffix_of(options.form), encode_pieces(raw.counts, options.form, metadata)),
        *((file_kind, ending, (data,)) for file_kind, ending, data in light.maps),
    ]
    if options.previews:
        files.append(("previews", ".jpg", (encode_preview(preview_of(raw.counts, white_level)),)))
    details: Details = {"crop": crop, "left": cut.left, "top": cut.top} if options.crops > 1 else {}
    record = ImageRecord(
        number=number,
        position=source.record.position,
        truth=light.truth,
        lights=light.rows,
        details=details | raw.details() | varied.details,
    )
    return Sample(record, source.record.name, source.record.split, width, height, tuple(files))


class NothingMadeError(FormatError):
    """None of the sources can be read, so there is no data set."""


class RenderingSums:
    """Sums over images for the rendering summary."""

    def __init__(self) -> None:
        self._sums = dict.fromkeys(("images", "pixels", "black_taken", "outside", "distance"), 0.0)

    def add(self, details: Details, pixels: int) -> None:
        """Add the details of an image."""
        self._sums["images"] += 1
        self._sums["black_taken"] += float(details.get("black_taken", 0))
        if "cells" in details:
            self._sums["pixels"] += pixels
            for name in ("outside", "distance"):
                self._sums[name] += pixels * float(details[name])

    def summary(self) -> RenderingSummary:
        """Return the means over pixels and images."""
        by_colour = {
            name: round(self._sums[name] / self._sums["pixels"], 6)
            for name in ("outside", "distance")
            if self._sums["pixels"]
        }
        black_taken = round(self._sums["black_taken"] / max(self._sums["images"], 1), 6)
        return RenderingSummary(**by_colour, black_taken=black_taken)


class _ListedFile:
    """A text file of the data set that is hashed while it is written."""

    def __init__(self, stack: ExitStack, store: Store, name: str) -> None:
        self.name = name
        self._writer = HashingWriter(stack.enter_context(store.create(name)))

    def write(self, text: str) -> None:
        """Append a text in UTF-8."""
        self._writer.write(text.encode())

    @property
    def sha256(self) -> str:
        """SHA-256 of the text written so far."""
        return self._writer.sha256

    @property
    def sum(self) -> str:
        """Line of the file in SHA256SUMS."""
        return f"{self.sha256}  {self.name}\n"


def assemble(workplace: Workplace, identity: Mapping[str, Any]) -> Dataset:
    """Write lists and description of a data set, publish it, and return it."""
    options = identity["options"]
    suffix = suffix_of(options["format"])
    counts: Counter[str] = Counter()
    splits: Counter[str] = Counter()
    skipped: list[Skipped] = []
    used: dict[int, Light] = {}
    labels: set[str] = set()
    details: _ListedFile | None = None
    rendered = RenderingSums()
    with ExitStack() as stack:
        truths = _ListedFile(stack, workplace.files, TRUTHS)
        named_truths = _ListedFile(stack, workplace.files, NAMED_TRUTHS)
        table = _ListedFile(stack, workplace.files, GROUND_TRUTH)
        sources_file = _ListedFile(stack, workplace.files, SOURCES)
        split_files = {
            split: _ListedFile(stack, workplace.files, f"splits/{split}.txt")
            for split in SPLITS
            if options["split"] is not None
        }
        sums = stack.enter_context(workplace.files.create(SUMS))
        has_uncertainty = bool(options.get("uncertainty"))
        table.write(csv_text([[*GROUND_TRUTH_COLUMNS, *([UNCERTAINTY_COLUMN] if has_uncertainty else [])]]))
        sources_file.write(csv_text([SOURCE_COLUMNS]))
        for record, new_sources, new_skipped in _records(workplace, int(identity["shards"])):
            names = {source.position: source for source in record.sources}
            for source in new_sources:
                sources_file.write(_source_row(source))
                counts["sources"] += 1
                counts["pixels"] += source.width * source.height * int(options.get("crops", 1))
                counts["replaced"] += source.replaced_pixels
            skipped += new_skipped
            used.update((light.illumination, light) for light in record.lights)
            for image in record.images:
                source = names[image.position]
                name = f"{image_key(image.number)}{suffix}"
                table.write(_image_rows(name, source.name, image, used if has_uncertainty else None))
                truth_text = "{:.9f} {:.9f} {:.9f}\n".format(*image.truth)
                truths.write(truth_text)
                named_truths.write(f"{name} {truth_text}")
                labels.update(light.illumination for light in image.lights)
                if image.details:
                    rendered.add(image.details, source.width * source.height)
                    if details is None:
                        details = _ListedFile(stack, workplace.files, IMAGES)
                        details.write(csv_text([["image", *image.details]]))
                    details.write(csv_text([[name, *map(_plain, image.details.values())]]))
                if source.split is not None:
                    split_files[source.split].write(f"{name}\n")
                    splits[source.split] += 1
                counts["images"] += 1
            for file in record.files:
                sums.write(f"{file.sha256}  {file.name}\n".encode())
        if not counts["images"]:
            raise NothingMadeError(
                f"0 of {identity['sources']['count']} pictures can be used, for the reasons listed above, "
                "expected 1 or more; give other pictures, or a smaller crop if they are too small"
            )
        description = Description(
            software=software(),
            libraries=identity["libraries"],
            table=TableRecord.model_validate(identity["table"]),
            seed=identity["seed"],
            options=options,
            planned=identity["images"],
            images=counts["images"],
            sources=counts["sources"],
            pixels=counts["pixels"],
            replaced_pixels=counts["replaced"],
            splits={split: splits[split] for split in split_files},
            lights=[used[light] for light in sorted(used)],
            skipped=skipped,
            rendering=rendered.summary() if {"rendering", "black_point"} & options.keys() else None,
        )
        text = (description.model_dump_json(indent=2) + "\n").encode()
        written = [table, truths, named_truths, sources_file, *split_files.values()]
        if details is not None:
            written.append(details)
        for file in written:
            sums.write(file.sum.encode())
        sums.write(f"{hashlib.sha256(text).hexdigest()}  {DESCRIPTION}\n".encode())
        # The authors complete these files by hand, so their hashes are not recorded.
        texts = {CARD: card(description), DATASHEET: datasheet(description)}
        for name, card_text in texts.items():
            workplace.files.put(name, card_text.encode())
    names = [file.name for file in written]
    workplace.files.sync([*names, SUMS, *COMPLETED_BY_HAND])
    # In an object store this file completes the data set, so it is written last.
    workplace.files.put(DESCRIPTION, text)
    workplace.files.sync([DESCRIPTION])
    workplace.publish()
    store = open_store(workplace.out)
    return Dataset(store, load_description(store), frozenset(labels))


def _records(workplace: Workplace, shards: int) -> Iterator[tuple[ShardRecord, list[SourceRecord], list[Skipped]]]:
    last: SourceRecord | Skipped | None = None
    for shard in range(shards):
        record = workplace.load(shard)
        ordered = sorted((*record.sources, *record.skipped), key=lambda source: source.position)
        if last is not None and ordered and ordered[0].position == last.position:
            if ordered[0] != last:
                raise FormatError(
                    f"the picture {last.name} differs between two shards, expected no change while the data set is "
                    f"made; remove {workplace.notes.location} and the files next to it, then start again"
                )
            new = ordered[1:]
        else:
            new = ordered
        if ordered:
            last = ordered[-1]
        yield (
            record,
            [source for source in new if isinstance(source, SourceRecord)],
            [source for source in new if isinstance(source, Skipped)],
        )


def _plain(value: float | str) -> str:
    # Nine digits represent every float32 exactly.
    return f"{value:.9g}" if isinstance(value, float) else str(value)


def _source_row(source: SourceRecord) -> str:
    cells = (source.position, source.name, source.sha256 or "", source.width, source.height, source.replaced_pixels)
    return csv_text([[*cells, source.split or "", source.profile or "", source.note or ""]])


def _image_rows(name: str, source: str, image: ImageRecord, used_lights: Mapping[int, Light] | None) -> str:
    # One row for each illuminant, with its uncertainty if `used_lights` are given.
    return csv_text(
        [
            name,
            source,
            light.illumination,
            *(f"{channel:.9f}" for channel in light.truth),
            *([] if used_lights is None else [_uncertainty(light.illumination, used_lights)]),
        ]
        for light in image.lights
    )


def _uncertainty(label: str, lights: Mapping[int, Light]) -> str:
    # Expanded uncertainty in degrees; empty if the LUT does not report it. A mixture gets the largest value of its
    # illuminants, because their errors have common causes and do not average out.
    uncertainties = [lights[int(term.partition(":")[0])].uncertainty_deg for term in label.split("+")]
    reported = [uncertainty for uncertainty in uncertainties if uncertainty is not None]
    return f"{max(reported):.4g}" if len(reported) == len(uncertainties) else ""


@dataclass(frozen=True)
class Workplace:
    """The location where a data set is made."""

    files: Store  # files of the data set
    notes: Store  # plan and records of shards, removed at the end
    out: str  # location of the complete data set
    plan_id: str  # first 16 hexadecimal digits of the SHA-256 of the plan

    def done(self, shards: Container[int]) -> set[int]:
        """Return the complete shards among `shards`; other records are not read."""
        recorded_shards = [shard for shard in self._recorded() if shard in shards]
        are_done = ordered_map(self.has, recorded_shards, _READERS)
        return {shard for shard, is_done in zip(recorded_shards, are_done, strict=True) if is_done}

    def count_done(self) -> int:
        """Return the number of complete shards, from the heads of their records."""
        return sum(ordered_map(self._has_shard_head, self._recorded(), _READERS))

    def _recorded(self) -> list[int]:
        # Complete and incomplete shards with a record.
        ending = f".{self.plan_id}"
        names = (PurePosixPath(name).name for name in self.notes.names(RECORDS))
        return [int(name.removesuffix(ending)) for name in names if name.endswith(ending)]

    def _has_shard_head(self, shard: int) -> bool:
        # An object store has records of complete shards only. On a disk, `commit` replaces the pieces of images.
        if not isinstance(self.notes, LocalStore):
            return True
        with self.notes.open(self._record_name(shard)) as stream:
            return f"\t{_SHARD_PIECE}\t".encode() in stream.read(_HEAD_BYTES)

    def has(self, shard: int) -> bool:
        """Return whether a shard is complete."""
        return _SHARD_PIECE in self.pieces(shard)

    def load(self, shard: int) -> ShardRecord:
        """Return the record of a complete shard."""
        piece = self.pieces(shard).get(_SHARD_PIECE)
        if piece is None:
            raise FormatError(
                f"{self.notes.location}/{self._record_name(shard)} is damaged; run the same command again"
            )
        return _record_in(piece, ShardRecord)

    def commit(self, record: ShardRecord) -> None:
        """Write the record of a shard after its files; from now on the shard is complete."""
        name = self._record_name(record.shard)
        self.notes.put(name, self._piece(_SHARD_PIECE, record).to_line())
        self.notes.sync([name])

    def note(self, shard: int, image: FinishedImage) -> None:
        """Record that all files of an image are written; may be called from any thread."""
        if isinstance(self.notes, LocalStore):
            self.notes.append(self._record_name(shard), self._piece(str(image.image.number), image).to_line())

    def pieces(self, shard: int) -> dict[str, Piece]:
        """Return the finished pieces of a shard by name."""
        name = self._record_name(shard)
        return read_pieces(self.notes.get(name), self.plan_id) if self.notes.has(name) else {}

    def image_of(self, piece: Piece) -> FinishedImage | None:
        """Return the image of a piece; None if one of its files has changed."""
        return _record_in(piece, FinishedImage) if piece.is_complete(self.files.open) else None

    def has_finished(self, needs_shard: bool = False) -> bool:
        """Return whether any plan has a finished image; if `needs_shard`, whether any plan has a complete shard."""
        names = self.notes.names(RECORDS)
        return any(not needs_shard or _SHARD_PIECE in read_pieces(self.notes.get(name)) for name in names)

    def discard(self) -> None:
        """Remove the records of complete shards, because resuming them would fail again."""
        self.notes.remove(RECORDS)

    def publish(self) -> None:
        """Make the files a complete data set; all of them must be written."""
        if isinstance(self.files, LocalStore):
            out = Path(self.out)
            require_free(out, "the data set")
            self.files.sweep()
            publish_folder(self.files.root, out, "the data set")
        remove_notes(self.notes)

    def _piece(self, name: str, record: ShardRecord | FinishedImage) -> Piece:
        return Piece(name, self.plan_id, {file.name: file.sha256 for file in record.files}, record.model_dump_json())

    def _record_name(self, shard: int) -> str:
        # A worker of a removed plan may still be running; it uses another name.
        return f"{RECORDS}/{shard_key(shard)}.{self.plan_id}"


_Finished = TypeVar("_Finished", ShardRecord, FinishedImage)


def _record_in(piece: Piece, record_type: type[_Finished]) -> _Finished:
    files = [FileSum(name=name, sha256=sha256) for name, sha256 in piece.files.items()]
    return from_json(record_type, piece.values, f"the piece {piece.name}", "make the data set again").model_copy(
        update={"files": files}
    )


def remove_notes(notes: Store) -> None:
    """Remove the notes; the plan is removed last, so that a killed program can be run again."""
    notes.remove(RECORDS)
    if isinstance(notes, LocalStore):
        shutil.rmtree(notes.root.parent, ignore_errors=True)
    else:
        notes.remove("")
