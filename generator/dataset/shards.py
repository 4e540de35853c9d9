"""A shard of a dataset: from its pictures to the record that says it is done; then what is made of all shards together.

Pictures are read, photographed and written. Where that happens (`Workplace`), work that was interrupted is continued,
and the dataset appears whole. On a disk everything happens in the hidden folder `.OUT.partial`: `dataset-ID/`, with the
plan's identifier, fills with files, and `plan/` has the plan and a record file of finished pieces for each shard
(`foundation.pieces`). At the end `dataset-ID/` gets its name by one rename, then the rest is removed. An object store
has no rename: the files are written where they stay, plan and records below `OUT/.plan/`, and `dataset.json`, written
last, makes a dataset of them.

Rules that hold inside:

- A shard's bytes depend on its job alone: not on the workers, on other shards, or on how often it is made.
- A shard is one piece, written when all else has been synchronised with the disk: a shard with its piece is whole. The
  program may be killed at any instruction, and any number of programs may make the same shard at once.
- Until then each image is a piece, and counts if its files are there with their hashes and its source is as it was. The
  bytes of the others do not depend on it. An object store cannot add to a file, so that it has no such pieces.
- At most about three pictures are in memory for each worker.

An image under one light has that light's ground truth, however its intensity falls off. Where it falls off with a tint
(`generator.variation.variation`) the light stands in the records twice, as it is at the near and at the far end, and
masks and maps say how much of either reaches a pixel.
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
from generator.dataset.joined import Beside
from generator.dataset.layouts import LAYOUTS, ShardWriter
from generator.dataset.plan import DatasetOptions, ShardJob, versions
from generator.dataset.reader import Dataset, load_description
from generator.dataset.records import (
    CARD,
    COMPLETED_BY_HAND,
    DATASHEET,
    GROUND_TRUTH,
    GROUND_TRUTH_COLUMNS,
    IMAGES,
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
from generator.rendering.matrices import matrix_for
from generator.stores import DESCRIPTION, LocalStore, Pieces, Store, open_store
from generator.variation.variation import AppliedVariation

if TYPE_CHECKING:
    from calibration.table.lut import Lut


PLAN: Final = "plan.json"
RECORDS: Final = "shards"
# Names among a place's notes: of the plan, of the folder of shards' records, and in a store of the notes' folder.
NOTES: Final = ".plan"
_WHOLE: Final = "shard"  # Name of the piece that is a shard; those of images are their numbers
_HEAD_BYTES: Final = 80  # Of a record: a line end, a SHA-256 and the name of its first piece
_READERS: Final = 16  # Record files that are read at a time: a store is waited for most of the time

PlanIdentity = Mapping[str, Any]

_threads: Final = threading.local()

# A shorter side below which a picture is noted: icons and failed downloads are so small, photographs never are.
TINY_PX: Final = 16

_WORD: Final = 1 << 64  # Values of the eight bytes of a hash that place a source among the parts


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


def light_of(lut: Lut, light: int) -> Light:
    """Return the record of light number `light` of the table."""
    shown, expanded = lut.illuminations[light], lut.truth_uncertainty_deg
    red, green, blue = (float(part) for part in lut.white[light])
    return Light(
        illumination=light,
        kind=shown.kind,
        cct_k=shown.cct_k,
        codes=shown.colour,
        white=(red, green, blue),
        name=shown.name,
        uncertainty_deg=None if expanded is None else float(f"{expanded[light]:.4g}"),
    )


@dataclass(frozen=True)
class ShownColours:
    """How well a print shows the colours of a picture; columns of `images.csv`.

    - `cells`: first 16 digits of the SHA-256 of the map of the print.
    - `outside`: share of the pixels that the print cannot show, 0 … 1.
    - `distance`: mean angle by which colours are missed, degrees.
    """

    cells: str
    outside: float
    distance: float


@dataclass(frozen=True, eq=False)
class RawImage:
    """The raw image of a print.

    - `counts`: (H, W, 3) uint16, linear camera RGB. One light: memory that the thread's next call overwrites.
    - `weights`: (H, W, K) float32, the share of each of several lights in each pixel; None with one light.
    - `black_taken`: share of the print's black that was taken out, 0 … 1; None if the black is kept.
    - `shown`: how the print shows the colours; None if it was rendered by codes.
    """

    counts: npt.NDArray[np.uint16]
    weights: npt.NDArray[np.float32] | None
    black_taken: float | None = None
    shown: ShownColours | None = None

    def details(self) -> Details:
        """Return the columns of `images.csv`."""
        shown: Details = {} if self.shown is None else dict(vars(self.shown))
        return shown if self.black_taken is None else shown | {"black_taken": self.black_taken}


def photograph(
    lut: Lut,
    picture: Picture,
    lighting: Lighting,
    options: DatasetOptions,
    seed: int,
    number: int,
    white_level: int,
) -> RawImage:
    """Return the raw image of a picture's print.

    `picture`: (H, W, 3) uint8, sRGB codes; where they are those of the print, of colours that the table has samples of.
    """
    # The hash of the table stands for its samples in the dataset's description.
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
        shown = ShownColours(rendering.map.sha256[:16], round(outside, 6), round(distance, 6))
        return RawImage(counts, weights, share, shown)
    tables = [_samples(lut, mixture, picture, share or 0.0, seed) for mixture in lighting.mixtures]
    if weights is None:
        counts = draw_samples(tables[0], picture, seed=seed, image=number, out=_reused(picture.shape))
    else:
        counts = mix_samples(tables, picture, weights, white_level=white_level, seed=seed, image=number)
    return RawImage(counts, weights, share)


def _samples(lut: Lut, mixture: Mixture, picture: Picture, share: float, seed: int) -> npt.NDArray[np.uint16]:
    """Return the samples of a light without a share of the print's black, at least those of a picture's colours."""
    samples = mixture.samples(lut, seed, picture)
    if not share:
        return samples
    colours = colours_in(picture, lut.provenance.bits) if picture.size < 3 * WHOLE_LIGHT_PIXELS else None
    veil = black_subtraction(lut, mixture, share)
    return subtract_black(samples, veil, lut.provenance.white_level, colours)


def _reused(shape: tuple[int, ...]) -> npt.NDArray[np.uint16]:
    """Return an array uint16 of any content in memory of the calling thread, which its next call overwrites.

    Fresh pages take as long to map as the drawing into them.
    """
    size = math.prod(shape)
    memory: npt.NDArray[np.uint16] | None = getattr(_threads, "memory", None)
    if memory is None or memory.size < size:
        _threads.memory = memory = np.empty(size, np.uint16)
    return memory[:size].reshape(shape)


@dataclass(frozen=True, eq=False)
class _ImageLight:
    """The light of one image.

    - `truth`: chromaticity, sum 1, of the light averaged over the pixels.
    - `maps`: kind, what follows the image's number in the file's name, and the bytes of each map beside the image.
    """

    truth: Triple
    rows: list[LightRow]
    maps: list[tuple[str, str, bytes]]


def _image_light(
    lut: Lut, lighting: Lighting, weights: npt.NDArray[np.float32] | None, varied: AppliedVariation, tints: bool
) -> _ImageLight:
    """Return the light of an image.

    `weights`: (H, W, K) float32, of each of K lights in each pixel; None of one light.
    """
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
    """Return (r, g, b) of sum 1 of linear RGB (3,) float64."""
    red, green, blue = (float(part) for part in white / white.sum())
    return red, green, blue


def _ignore(*arguments: object) -> None:
    del arguments


@dataclass(frozen=True)
class Callbacks:
    """What is called while images are made, always from the calling thread.

    Attributes
    ----------
    on_done
        Takes how many more of the planned images are found finished: of the shards that are done before the first image
        is made, and of a shard that was begun when it is taken up; less than 0 for images whose source proves to have
        changed since, which are made again.
    on_image
        Called after each image.
    on_skip
        Takes the name of a source that cannot be read, the reason, and the number of images that are left out.
    on_wait
        Takes a sentence for the user where the work waits for somebody to do something.

    Examples
    --------
    >>> left_out = []
    >>> callbacks = Callbacks(on_skip=lambda name, reason, images: left_out.append(name))
    >>> callbacks.on_skip("bad.png", "bad.png is no picture", 2)
    >>> left_out
    ['bad.png']
    """

    on_done: Callable[[int], None] = _ignore
    on_image: Callable[[], None] = _ignore
    on_skip: Callable[[str, str, int], None] = _ignore
    on_wait: Callable[[str], None] = _ignore


SILENT: Final = Callbacks()  # Callbacks that do nothing


@dataclass(frozen=True)
class _ReadSource:
    """The crops of a source, or all of it, and what is recorded of it; no crops where all its images are finished.

    Where sRGB codes are those of the print, they are codes that the table has samples of.
    """

    cuts: tuple[Cut, ...]
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
    """Make a shard and commit its record."""
    sources: list[SourceRecord] = []
    skipped: list[Skipped] = []
    images: list[ImageRecord] = []
    used: set[int] = set()
    pending: deque[Future[Sample]] = deque()
    reading: deque[Future[_ReadSource]] = deque()
    finished = _finished_images(job, place, pool)
    if finished:
        callbacks.on_done(len(finished))

    def finish_one(writer: ShardWriter) -> None:
        sample = pending.popleft().result()
        writer.append(sample)
        images.append(sample.record)
        if sample.record.number not in finished:
            callbacks.on_image()

    def forget_changed(wanted: list[tuple[int, int, Lighting]], source: SourceRecord | None) -> None:
        changed = [number for number, _, _ in wanted if number in finished and finished[number].source != source]
        for number in changed:
            del finished[number]
        if changed:
            callbacks.on_done(-len(changed))

    with _writer_of(job, place) as writer, _cancelling(pending, reading):
        for row, source in enumerate(job.sources):
            while len(reading) <= workers and row + len(reading) < len(job.sources):
                reading.append(pool.submit(_read, job, lut, row + len(reading), finished))
            wanted = _wanted(job, job.position + row)
            try:
                read = reading.popleft().result()
            except FormatError as error:
                forget_changed(wanted, None)
                skipped.append(Skipped(position=job.position + row, name=source.name))
                callbacks.on_skip(source.name, str(error), len(wanted))
                continue
            forget_changed(wanted, read.record)
            sources.append(read.record)
            for number, crop, lighting in wanted:
                while len(pending) >= 2 * workers:
                    finish_one(writer)
                if cancelled is not None and cancelled.is_set():
                    raise ShardCancelled
                used.update(light for mixture in lighting.mixtures for light in mixture.lights)
                if number in finished:
                    pending.append(pool.submit(_taken_up, finished[number]))
                else:
                    pending.append(pool.submit(_photographed, job, lut, place, writer, number, read, crop, lighting))
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


def _finished_images(job: ShardJob, place: Workplace, pool: ThreadPoolExecutor) -> dict[int, FinishedImage]:
    # Another program may have committed the whole shard meanwhile.
    pieces = [piece for name, piece in place.pieces(job.shard).items() if name != _WHOLE]
    return {image.image.number: image for image in pool.map(place.image_of, pieces) if image is not None}


def _taken_up(image: FinishedImage) -> Sample:
    """Return a finished image for the writer's `append`."""
    source = image.source
    return Sample(image.image, source.name, source.split, source.width, source.height, (), tuple(image.files))


def _writer_of(job: ShardJob, place: Workplace) -> ShardWriter:
    options = job.options
    lightings = job.choice.lightings_of(job.position * options.crops)
    maps = options.tints or any(lighting.masks is not None for lighting in lightings)
    beside = Beside(options.previews, maps, options.has_details)
    return LAYOUTS[options.layout].open_writer(place.files, job.shard, beside)


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
    """Result of a task: how many images its shard has, and of each source that cannot be read name, reason, images.

    `found`: how many of the images whoever was at the shard before had finished.
    """

    images: int
    skipped: tuple[tuple[str, str, int], ...]
    found: int = 0


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
    taken_up: list[int] = []

    def skip(name: str, reason: str, images: int) -> None:
        skipped.append((name, reason, images))

    lut = _table_of(job.table, job.table_sha256)
    with ThreadPoolExecutor(1) as pool:
        record = make_shard(job, lut, place, pool, 1, Callbacks(on_done=taken_up.append, on_skip=skip))
    return ShardDone(len(record.images), tuple(skipped), sum(taken_up))


@lru_cache(maxsize=2)
def _table_of(folder: Path, sha256: str) -> Lut:
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


def _read(job: ShardJob, lut: Lut, place: int, finished: Mapping[int, FinishedImage]) -> _ReadSource:
    known = _known_source(job, job.position + place, finished) if finished else None
    if known is not None:
        return _ReadSource((), known)
    source: Source = job.sources[place]
    scene = source.read()
    whole = (Cut(0, 0, scene.picture),) if job.options.crops == 1 else scene.cuts
    if len(whole) != job.options.crops:
        raise InputError(
            f"{source.name} has {max(1, len(whole))} crops, expected {job.options.crops}; give the preparation of "
            "pictures and the options of the dataset the same number, and leave random scenes out"
        )
    if job.options.rendering == "codes":
        fit = [replace_unfit_colours(cut.picture, lut.provenance) for cut in whole]
    else:
        # Mixtures of cells hold fit ones alone.
        fit = [(cut.picture, 0) for cut in whole]
    height, width = scene.picture.shape[:2]
    least = FILE_FORMATS[job.options.form].smallest_side
    if min(height, width) < least:
        raise FormatError(
            f"{source.name} is {width}x{height} px, too small for {job.options.form}, which takes {least}x{least} and "
            "more; choose another format, or leave it out"
        )
    notes = [*scene.notes]
    if min(height, width) < TINY_PX:
        notes.append(f"tiny, {width}x{height} px")
    if not all(cut.picture.any() for cut in whole):
        notes.append("all black")
    record = SourceRecord(
        position=job.position + place,
        name=source.name,
        sha256=scene.sha256,
        profile=scene.profile or None,
        width=width,
        height=height,
        replaced_pixels=sum(replaced for _, replaced in fit),
        split=split_of(job.options.split, job.seed, scene.sha256, source.name),
        note="; ".join(notes) or None,
    )
    cuts = tuple(replace(cut, picture=picture) for cut, (picture, _) in zip(whole, fit, strict=True))
    return _ReadSource(cuts, record)


def _known_source(job: ShardJob, position: int, finished: Mapping[int, FinishedImage]) -> SourceRecord | None:
    """Return the record of a source that is as it was when every image of it was finished; else None."""
    known = [finished[number].source if number in finished else None for number, _, _ in _wanted(job, position)]
    first = known[0] if known else None
    if first is None or any(source != first for source in known):
        return None
    # Of a file on a store no hash is known before it is read.
    return first if changed_sha256(job.sources[position - job.position], -math.inf) == first.sha256 else None


def _photographed(
    job: ShardJob,
    lut: Lut,
    place: Workplace,
    writer: ShardWriter,
    number: int,
    source: _ReadSource,
    crop: int,
    lighting: Lighting,
) -> Sample:
    options, cut = job.options, source.cuts[crop]
    height, width = cut.picture.shape[:2]
    white_level = lut.provenance.white_level
    # What exceeds saturation may be below it once it is exposed anew, and is cut then.
    most = white_level if options.variation is None else FULL
    raw = photograph(lut, cut.picture, lighting, options, job.seed, number, most)
    varied = AppliedVariation()
    if options.variation is not None:
        varied = options.variation.apply(raw.counts, white_level, job.seed, number)
    light = _image_light(lut, lighting, raw.weights, varied, options.tints)
    metadata = ImageMetadata(white_level, light.truth, lut.provenance.camera)
    files: list[tuple[str, str, Pieces]] = [
        ("images", suffix_of(options.form), encode_pieces(raw.counts, options.form, metadata)),
        *((kind, ending, (data,)) for kind, ending, data in light.maps),
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
    sample = writer.store(Sample(record, source.record.name, source.record.split, width, height, tuple(files)))
    if sample.stored:
        place.note(job.shard, FinishedImage(image=record, source=source.record, files=list(sample.stored)))
    return sample


class NothingMadeError(FormatError):
    """None of the sources can be read, so there is no dataset."""


class _RenderingSums:
    """Adds up how images were rendered."""

    def __init__(self) -> None:
        self._sums = dict.fromkeys(("images", "pixels", "black_taken", "outside", "distance"), 0.0)

    def add(self, details: Details, pixels: int) -> None:
        """Add what is recorded of an image of so many pixels."""
        self._sums["images"] += 1
        self._sums["black_taken"] += float(details.get("black_taken", 0))
        if "cells" in details:
            self._sums["pixels"] += pixels
            for name in ("outside", "distance"):
                self._sums[name] += pixels * float(details[name])

    def summary(self) -> RenderingSummary:
        """Return means over pixels and images."""
        by_colour = {
            name: round(self._sums[name] / self._sums["pixels"], 6)
            for name in ("outside", "distance")
            if self._sums["pixels"]
        }
        black_taken = round(self._sums["black_taken"] / max(self._sums["images"], 1), 6)
        return RenderingSummary(**by_colour, black_taken=black_taken)


class _ListedFile:
    """A text file of the dataset that is written in order and hashed while it is written."""

    def __init__(self, stack: ExitStack, store: Store, name: str) -> None:
        self.name = name
        self._writer = HashingWriter(stack.enter_context(store.create(name)))

    def write(self, text: str) -> None:
        """Append a text, as UTF-8."""
        self._writer.write(text.encode())

    @property
    def sha256(self) -> str:
        """Of what was written so far."""
        return self._writer.sha256

    @property
    def sum(self) -> str:
        """The file's line in SHA256SUMS."""
        return f"{self.sha256}  {self.name}\n"


def assemble(place: Workplace, identity: Mapping[str, Any]) -> Dataset:
    """Write what a dataset has beside its images, give the dataset its name, and return it; its lists are not read."""
    options = identity["options"]
    suffix = suffix_of(options["format"])
    counts: Counter[str] = Counter()
    splits: Counter[str] = Counter()
    skipped: list[Skipped] = []
    used: dict[int, Light] = {}
    labels: set[str] = set()
    details: _ListedFile | None = None
    rendered = _RenderingSums()
    with ExitStack() as stack:
        truths = _ListedFile(stack, place.files, TRUTHS)
        table = _ListedFile(stack, place.files, GROUND_TRUTH)
        listed = _ListedFile(stack, place.files, SOURCES)
        parts = {
            part: _ListedFile(stack, place.files, f"splits/{part}.txt")
            for part in SPLITS
            if options["split"] is not None
        }
        sums = stack.enter_context(place.files.create(SUMS))
        stated = bool(options.get("uncertainty"))
        table.write(csv_text([[*GROUND_TRUTH_COLUMNS, *([UNCERTAINTY_COLUMN] if stated else [])]]))
        listed.write(csv_text([SOURCE_COLUMNS]))
        for record, fresh, left_out in _records(place, int(identity["shards"])):
            names = {source.position: source for source in record.sources}
            for source in fresh:
                listed.write(_source_row(source))
                counts["sources"] += 1
                counts["pixels"] += source.width * source.height * int(options.get("crops", 1))
                counts["replaced"] += source.replaced_pixels
            skipped += left_out
            used.update((light.illumination, light) for light in record.lights)
            for image in record.images:
                source = names[image.position]
                name = f"{image_key(image.number)}{suffix}"
                table.write(_image_rows(name, source.name, image, used if stated else None))
                truths.write("{:.9f} {:.9f} {:.9f}\n".format(*image.truth))
                labels.update(light.illumination for light in image.lights)
                if image.details:
                    rendered.add(image.details, source.width * source.height)
                    if details is None:
                        details = _ListedFile(stack, place.files, IMAGES)
                        details.write(csv_text([["image", *image.details]]))
                    details.write(csv_text([[name, *map(_plain, image.details.values())]]))
                if source.split is not None:
                    parts[source.split].write(f"{name}\n")
                    splits[source.split] += 1
                counts["images"] += 1
            for file in record.files:
                sums.write(f"{file.sha256}  {file.name}\n".encode())
        if not counts["images"]:
            raise NothingMadeError(
                f"none of the {identity['sources']['count']} pictures can be used: all were "
                "left out, each with its reason; name others, or ask for a smaller crop if they are too small"
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
            splits={part: splits[part] for part in parts},
            lights=[used[light] for light in sorted(used)],
            skipped=skipped,
            rendering=rendered.summary() if {"rendering", "black_point"} & options.keys() else None,
        )
        text = (description.model_dump_json(indent=2) + "\n").encode()
        written = [table, truths, listed, *parts.values()]
        if details is not None:
            written.append(details)
        for file in written:
            sums.write(file.sum.encode())
        sums.write(f"{hashlib.sha256(text).hexdigest()}  {DESCRIPTION}\n".encode())
        # Its makers complete them, so that no hash of them is recorded.
        texts = {CARD: card(description), DATASHEET: datasheet(description)}
        for name, card_text in texts.items():
            place.files.put(name, card_text.encode())
    names = [file.name for file in written]
    place.files.sync([*names, SUMS, *COMPLETED_BY_HAND])
    # In an object store this makes it a dataset, so everything else is there.
    place.files.put(DESCRIPTION, text)
    place.files.sync([DESCRIPTION])
    place.publish()
    store = open_store(place.out)
    return Dataset(store, load_description(store), frozenset(labels))


def _records(place: Workplace, shards: int) -> Iterator[tuple[ShardRecord, list[SourceRecord], list[Skipped]]]:
    last: SourceRecord | Skipped | None = None
    for shard in range(shards):
        record = place.load(shard)
        ordered = sorted((*record.sources, *record.skipped), key=lambda source: source.position)
        if last is not None and ordered and ordered[0].position == last.position:
            if ordered[0] != last:
                raise FormatError(
                    f"the picture {last.name} changed, or could be read only once, while the dataset was made; remove "
                    f"{place.notes.place} with all beside it and begin again"
                )
            fresh = ordered[1:]
        else:
            fresh = ordered
        if ordered:
            last = ordered[-1]
        yield (
            record,
            [source for source in fresh if isinstance(source, SourceRecord)],
            [source for source in fresh if isinstance(source, Skipped)],
        )


def _plain(value: float | str) -> str:
    """Return a value of `images.csv`; nine digits give back every float32."""
    return f"{value:.9g}" if isinstance(value, float) else str(value)


def _source_row(source: SourceRecord) -> str:
    known = (source.position, source.name, source.sha256 or "", source.width, source.height, source.replaced_pixels)
    return csv_text([[*known, source.split or "", source.profile or "", source.note or ""]])


def _image_rows(name: str, source: str, image: ImageRecord, stated: Mapping[int, Light] | None) -> str:
    """Return the rows of an image's lights, with what each may be off by where the table's lights are given."""
    return csv_text(
        [
            name,
            source,
            light.illumination,
            *(f"{part:.9f}" for part in light.truth),
            *([] if stated is None else [_uncertainty(light.illumination, stated)]),
        ]
        for light in image.lights
    )


def _uncertainty(label: str, lights: Mapping[int, Light]) -> str:
    """Return the expanded uncertainty of a light by its label, degrees: of a mixture the largest of its parts'.

    Errors of a table's lights have causes in common, so that they do not cancel in a mixture, and a mixture lies
    between its parts. Nothing where the table does not state one.
    """
    parts = [lights[int(part.partition(":")[0])].uncertainty_deg for part in label.split("+")]
    known = [part for part in parts if part is not None]
    return f"{max(known):.4g}" if len(known) == len(parts) else ""


@dataclass(frozen=True)
class Workplace:
    """Where a dataset is being made.

    - `files`: what will be the dataset.
    - `notes`: the plan and the shards' records, which are removed at the end.
    - `out`: the dataset's place.
    - `plan_id`: identifier of the plan; see `generator.dataset.making`.
    """

    files: Store
    notes: Store
    out: str
    plan_id: str

    def done(self, wanted: Container[int]) -> set[int]:
        """Return which of the wanted shards are done; records of others are not read."""
        shards = [shard for shard in self._recorded() if shard in wanted]
        whole = ordered_map(self.has, shards, _READERS)
        return {shard for shard, is_done in zip(shards, whole, strict=True) if is_done}

    def count_done(self) -> int:
        """Return how many shards are done by the heads of their records; the rest of a record is not read."""
        return sum(ordered_map(self._is_headed_whole, self._recorded(), _READERS))

    def _recorded(self) -> list[int]:
        """Return the shards that have a record, of the whole or of images."""
        ending = f".{self.plan_id}"
        found = (PurePosixPath(name).name for name in self.notes.names(RECORDS))
        return [int(name.removesuffix(ending)) for name in found if name.endswith(ending)]

    def _is_headed_whole(self, shard: int) -> bool:
        # In a store there are no records of images; elsewhere `commit` replaces them, so that the whole comes first.
        if not isinstance(self.notes, LocalStore):
            return True
        with self.notes.open(self._record_name(shard)) as stream:
            return f"\t{_WHOLE}\t".encode() in stream.read(_HEAD_BYTES)

    def has(self, shard: int) -> bool:
        """Return whether a shard is done."""
        return _WHOLE in self.pieces(shard)

    def load(self, shard: int) -> ShardRecord:
        """Return the record of a shard that is done."""
        whole = self.pieces(shard).get(_WHOLE)
        if whole is None:
            raise FormatError(f"{self.notes.place}/{self._record_name(shard)} is damaged; run the same command again")
        return _record_in(whole, ShardRecord)

    def commit(self, record: ShardRecord) -> None:
        """Bring the record of a shard to the disk whose files are there: from here on it is done."""
        name = self._record_name(record.shard)
        self.notes.put(name, self._piece(_WHOLE, record).to_line())
        self.notes.sync([name])

    def note(self, shard: int, image: FinishedImage) -> None:
        """Note that all files of an image of a shard are written; any thread may do so."""
        if isinstance(self.notes, LocalStore):
            self.notes.append(self._record_name(shard), self._piece(str(image.image.number), image).to_line())

    def pieces(self, shard: int) -> dict[str, Piece]:
        """Return the finished pieces of a shard by their names."""
        name = self._record_name(shard)
        return read_pieces(self.notes.get(name), self.plan_id) if self.notes.has(name) else {}

    def image_of(self, piece: Piece) -> FinishedImage | None:
        """Return the image that a piece is; None if a file of it is not as it was written."""
        return _record_in(piece, FinishedImage) if piece.is_complete(self.files.open) else None

    def has_finished(self, shard: bool = False) -> bool:
        """Return whether an image is finished, or a `shard`, of this plan or of another one."""
        names = self.notes.names(RECORDS)
        return any(not shard or _WHOLE in read_pieces(self.notes.get(name)) for name in names)

    def discard(self) -> None:
        """Remove the records of the shards that are done, since to continue would end the same."""
        self.notes.remove(RECORDS)

    def publish(self) -> None:
        """Make a dataset of the files; all of them, the description last, are there."""
        if isinstance(self.files, LocalStore):
            out = Path(self.out)
            require_free(out, "the dataset")
            self.files.sweep()
            publish_folder(self.files.root, out, "the dataset")
        remove_notes(self.notes)

    def _piece(self, name: str, record: ShardRecord | FinishedImage) -> Piece:
        return Piece(name, self.plan_id, {file.name: file.sha256 for file in record.files}, record.model_dump_json())

    def _record_name(self, shard: int) -> str:
        # A worker of a plan that was removed may still be alive: it writes under another name.
        return f"{RECORDS}/{shard_key(shard)}.{self.plan_id}"


_Finished = TypeVar("_Finished", ShardRecord, FinishedImage)


def _record_in(piece: Piece, kind: type[_Finished]) -> _Finished:
    files = [FileSum(name=name, sha256=sha256) for name, sha256 in piece.files.items()]
    return from_json(kind, piece.values, f"the piece {piece.name}", "make the dataset again").model_copy(
        update={"files": files}
    )


def remove_notes(notes: Store) -> None:
    """Remove the notes, the plan last: until then a program that is run again finds that the dataset is its own."""
    notes.remove(RECORDS)
    if isinstance(notes, LocalStore):
        shutil.rmtree(notes.root.parent, ignore_errors=True)
    else:
        notes.remove("")
