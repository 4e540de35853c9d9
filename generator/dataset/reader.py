"""A dataset: its reader, and the call that makes one.

    images/NNNNNN.png    linear camera RGB in the units of the table; the number is the one that was planned
    masks/, ground_truth/  where several lights fall on an image; see `masks.files`
    previews/NNNNNN.jpg  the same, tone mapped, at most 512 px: the look of the raw, no white balance
    ground_truth.csv     image,source,illumination,r,g,b with r + g + b = 1, one row a light
    gt.txt               r g b a line in image order: the mean of the lights over the image
    sources.csv          position,name,sha256,width,height,replaced_pixels,split,profile
    splits/train.txt …   names of images, where the dataset was divided
    dataset.json         the table's hash, seed, options: enough to make every byte again
    SHA256SUMS           hashes of all files; `sha256sum -c SHA256SUMS` verifies

Image number `position · lights_each + k` shows the source at `position` under its k-th light. A source that cannot be
read leaves its numbers free and is listed. In the layouts `webdataset` and `parquet` the images of a shard lie together
in `data/NNNNNN.tar` or `.parquet`, or below the name of their part. No byte depends on the workers, the clock or the
machine's paths; the encoders and decoders are the libraries', whose versions are recorded.
"""

from __future__ import annotations

import csv
import io
import json
import sys
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import groupby
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from foundation.errors import FormatError, InputError, first_of
from generator.dataset.production.assembly import (
    GROUND_TRUTH,
    GROUND_TRUTH_COLUMNS,
    SOURCES,
    TRUTHS,
    NothingMadeError,
    assemble,
)
from generator.dataset.production.engines import OnWait, check_workers, make_shards
from generator.dataset.production.layouts import member_name, read_member
from generator.dataset.production.plan import SHARD_IMAGES, Options, Plan
from generator.dataset.production.records import (
    FORMAT,
    SPLITS,
    VERSION,
    Description,
    Entry,
    Layout,
    SourceRecord,
    Split,
    Triple,
    shard_key,
)
from generator.dataset.production.shards import OnImage, OnSkip
from generator.dataset.production.workplace import Workplace, finished, stored_identity, workplace
from generator.dataset.store import DESCRIPTION, Store, open_store
from generator.files.formats import Format, decode_image
from generator.lights.choices import ListedLights
from generator.lights.lighting import LightChoice, parse_mixture

if TYPE_CHECKING:
    from calibration.table.lut import Lut
    from generator.pictures.sources import Source

__all__ = [
    "Dataset",
    "Description",
    "Entry",
    "finish_dataset",
    "generate_dataset",
    "make_dataset",
    "make_share",
    "open_dataset",
]

OnDone = Callable[[int], None]

_LIGHT = "with r + g + b = 1 and none below 0"
_ROUNDING = 2e-6
"""More than six digits are off by, and less than a thousandth of a degree."""


@dataclass(frozen=True)
class Dataset:
    """A dataset on disk or in a store; images are read where they are used.

    Attributes
    ----------
    store
        Where its files are.
    description
        The content of `dataset.json`.
    entries
        Its images in the order of their numbers.
    """

    store: Store
    description: Description
    entries: tuple[Entry, ...]

    def read_image(self, entry: Entry) -> npt.NDArray[np.uint16]:
        """Return the image (H, W, 3) uint16, linear camera RGB, `description.table.white_level` = saturation.

        Raises
        ------
        FormatError
            The file is missing, damaged or no image of its format.
        """
        name = self._name(entry.image, entry.split, "images")
        return decode_image(self._bytes(name), self.description.options["format"], f"{self.store.place}/{name}")

    def read_preview(self, entry: Entry) -> bytes | None:
        """Return the JPEG file of an image's preview, or None if the dataset has none."""
        if not self.description.options["previews"]:
            return None
        return self._beside(entry, "previews", ".jpg")

    def read_weights(self, entry: Entry) -> npt.NDArray[np.float32]:
        """Return how the lights of an image share its pixels: (H, W, K) float32, in the order of `entry.lights`, sum 1.

        Raises
        ------
        InputError
            One light falls on the image.
        FormatError
            A file is missing or damaged.
        """
        from generator.masks.files import decode_weights

        masks = [self._map(entry, "masks", f"_{light}.png") for light in range(len(entry.lights))]
        return decode_weights(masks, self._of(entry, "masks"))

    def read_ground_truth_map(self, entry: Entry) -> npt.NDArray[np.float32]:
        """Return the ground truth of every pixel of an image: (H, W, 3) float32, r + g + b = 1.

        Raises
        ------
        InputError
            One light falls on the image: `entry.truth` is that of every pixel.
        FormatError
            The file is missing or damaged.
        """
        from generator.masks.files import decode_ground_truth

        return decode_ground_truth(self._map(entry, "ground_truth", ".png"), self._of(entry, "ground truth"))

    @property
    def layout(self) -> str:
        """How its images lie."""
        return str(self.description.options.get("layout", "folder"))

    @cached_property
    def sources(self) -> tuple[SourceRecord, ...]:
        """The sources that were used, in their order.

        Raises
        ------
        FormatError
            Their list is damaged.
        """
        rows: Iterable[dict[str, Any]]
        if self.store.has(SOURCES):
            rows = csv.DictReader(io.StringIO(self.store.get(SOURCES).decode("utf-8", "replace")))
        else:
            rows = json.loads(self.store.get(DESCRIPTION))["sources"]  # Version 1 had them there.
        try:
            return tuple(
                SourceRecord.model_validate({key: None if value == "" else value for key, value in row.items()})
                for row in rows
            )
        except ValidationError as error:
            raise FormatError(f"{self.store.place}/{SOURCES} is damaged; make the dataset again") from error

    def _name(self, file: str, split: str | None, kind: str) -> str:
        if self.layout == "folder":
            return f"{kind}/{file}"
        number = int(file.partition(".")[0])
        shard = shard_key(number // int(self.description.options["shard_images"]))
        return f"{split or 'data'}/{shard}.{'tar' if self.layout == 'webdataset' else 'parquet'}/{file}"

    def _map(self, entry: Entry, kind: str, ending: str) -> bytes:
        """Return the file of a map that lies beside an image of several lights."""
        if len(entry.lights) == 1:
            raise InputError(f"one light falls on {entry.image}, so that it has no masks; see its truth")
        return self._beside(entry, kind, ending)

    def _beside(self, entry: Entry, kind: str, ending: str) -> bytes:
        """Return a file that lies beside an image."""
        key = PurePosixPath(entry.image).stem
        file = f"{key}{ending}" if self.layout == "folder" else member_name(kind, key, ending)
        return self._bytes(self._name(file, entry.split, kind))

    def _of(self, entry: Entry, what: str) -> str:
        return f"{self.store.place}, the {what} of {entry.image},"

    def _bytes(self, name: str) -> bytes:
        if self.layout == "folder":
            return self.store.get(name)
        container, _, file = name.rpartition("/")
        return read_member(self.layout, self.store, container, file)


def open_dataset(place: Path | str) -> Dataset:
    """Open a dataset; reads no image.

    Parameters
    ----------
    place
        Its folder, or its URL in a store that fsspec knows.

    Raises
    ------
    FormatError
        There is no dataset, it is of a version not known here, or its files disagree.
    """
    store = open_store(place)
    if not store.has(DESCRIPTION):
        raise FormatError(f"{place} is no dataset: it has no {DESCRIPTION}; make one with generate")
    description = _load_description(store)
    return Dataset(store, description, tuple(_entries(store, description)))


def _load_description(store: Store) -> Description:
    name = f"{store.place}/{DESCRIPTION}"
    try:
        told: dict[str, Any] = json.loads(store.get(DESCRIPTION))
        if told["version"] == 1:
            told = _upgraded(told)
        return Description.model_validate(told)
    except ValidationError as error:
        first = error.errors()[0]
        raise FormatError(
            f"{name} is no dataset's description: {'.'.join(map(str, first['loc']))}: {first['msg']}; this software "
            f"reads {FORMAT} of versions 1 to {VERSION}"
        ) from error
    except (ValueError, KeyError, TypeError) as error:
        raise FormatError(f"{name} is damaged ({error}); make the dataset again") from error


def _upgraded(told: dict[str, Any]) -> dict[str, Any]:
    """Return a description of version 1, which listed the sources themselves, as one of version 2."""
    sources = told["sources"]
    counts = {
        "sources": len(sources),
        "pixels": sum(source["width"] * source["height"] for source in sources),
        "replaced_pixels": sum(source["replaced_pixels"] for source in sources),
    }
    return told | counts | {"version": VERSION, "planned": told["images"]}


def _entries(store: Store, description: Description) -> Iterator[Entry]:
    """Yield the images of `ground_truth.csv`, whose rows of one image follow each other, as `gt.txt` has them too."""
    name = f"{store.place}/{GROUND_TRUTH}"
    part_of: dict[int, Split] = {}
    for part in SPLITS:
        if part in description.splits:
            with _text(store, f"splits/{part}.txt") as images:
                part_of.update((_number(image), part) for image in images)
    with _text(store, TRUTHS) as truths, _text(store, GROUND_TRUTH) as table:
        last, count = -1, 0
        for image, group in groupby(_numbered_rows(name, table), key=lambda numbered: numbered[1].get("image")):
            count += 1
            source, labels, whites = _read_rows(name, group)
            number = _number(image or "")
            if image is None or number <= last:
                raise FormatError(f"{name}: {image!r} is not in the order of the images; make the dataset again")
            last = number
            truth = _truth(store, next(truths, ""), count, image, whites)
            yield Entry(image, source, labels, whites, truth, part_of.get(number))
        if count != description.images:
            raise FormatError(
                f"{name} has rows of {count} images, expected the {description.images} of {DESCRIPTION}; make the "
                "dataset again"
            )
        more = sum(1 for line in truths if line.strip())
        if more:
            raise FormatError(
                f"{store.place}/{TRUTHS} has {count + more} lines, expected one for each of the {count} images of "
                f"{GROUND_TRUTH}; make the dataset again"
            )


def _numbered_rows(name: str, table: Iterable[str]) -> Iterator[tuple[int, dict[str, str]]]:
    """Yield the rows of a CSV file with the line where each ends."""
    rows = csv.DictReader(table)
    try:
        for row in rows:
            yield rows.line_num, row
    except csv.Error as error:
        raise FormatError(f"{name}, line {rows.line_num + 1} is no CSV: {error}; make the dataset again") from error


def _read_rows(
    name: str, rows: Iterable[tuple[int, dict[str, str]]]
) -> tuple[str, tuple[str, ...], tuple[Triple, ...]]:
    """Return source, names of the lights, and ground truth of each, of an image's rows with their line numbers."""
    lights: list[tuple[str, Triple]] = []
    source = ""
    for line, row in rows:
        try:
            lights.append(_light(row["illumination"], row["r"], row["g"], row["b"]))
            source = sys.intern(row["source"])
        except (KeyError, TypeError, ValueError, InputError) as error:
            raise FormatError(
                f"{name}, line {line}: expected {','.join(GROUND_TRUTH_COLUMNS)} {_LIGHT}, found "
                f"{_shown(','.join(map(str, row.values())))}; make the dataset again"
            ) from error
    return source, *_unzipped(tuple(lights))


def _truth(store: Store, text: str, line: int, image: str, lights: tuple[Triple, ...]) -> Triple:
    """Return the mean of an image's lights by its line of `gt.txt`; a FormatError if it cannot be their mean."""
    name = f"{store.place}/{TRUTHS}, line {line}"
    try:
        truth = _triple(*text.split())
    except (TypeError, ValueError) as error:
        raise FormatError(
            f"{name}: expected the light of {image}, r g b {_LIGHT}, found {_shown(text.strip())}; make the dataset "
            "again"
        ) from error
    if not _is_among(truth, lights):
        told = " and ".join("{:g} {:g} {:g}".format(*light) for light in lights)
        raise FormatError(
            f"{name}: {text.strip()} is not the light of {image}, which is {told} in {GROUND_TRUTH}; see with generate "
            f"--verify {store.place} which of the two files has changed, and restore it"
        )
    return truth


# As for `_triple`.
@lru_cache(maxsize=4096)
def _is_among(mean: Triple, lights: tuple[Triple, ...]) -> bool:
    """Return whether lights may have this mean; one light is its own."""
    return all(
        min(parts) - _ROUNDING <= part <= max(parts) + _ROUNDING for part, *parts in zip(mean, *lights, strict=True)
    )


def _shown(text: str) -> str:
    """Return what stands in a line, cut where it is long."""
    return repr(text if len(text) <= 80 else f"{text[:80]}…") if text else "nothing"


@contextmanager
def _text(store: Store, name: str) -> Generator[io.TextIOWrapper]:
    """Open a file of text to be read line by line."""
    with store.open(name) as stream, io.TextIOWrapper(stream, "utf-8-sig", "replace", newline="") as text:
        yield text


def _number(image: str) -> int:
    """Return the number of an image by its name; -1 if it has none."""
    digits = image.partition(".")[0]
    return int(digits) if digits.isdecimal() else -1


# Many images share a light: what is alike is kept once.
@lru_cache(maxsize=4096)
def _light(label: str, red: str, green: str, blue: str) -> tuple[str, Triple]:
    return parse_mixture(label).label, _triple(red, green, blue)


@lru_cache(maxsize=4096)
def _unzipped(lights: tuple[tuple[str, Triple], ...]) -> tuple[tuple[str, ...], tuple[Triple, ...]]:
    return tuple(label for label, _ in lights), tuple(white for _, white in lights)


@lru_cache(maxsize=4096)
def _triple(red: str, green: str, blue: str) -> Triple:
    triple = float(red), float(green), float(blue)
    if not (min(triple) >= 0 and abs(sum(triple) - 1) <= _ROUNDING):
        raise ValueError(f"{triple} is no chromaticity")
    return triple


def generate_dataset(
    lut: Lut,
    out: Path | str,
    sources: Sequence[Source],
    lights: LightChoice | Sequence[int],
    *,
    seed: int = 0,
    form: Format = "png",
    layout: Layout = "folder",
    previews: bool = True,
    split: tuple[float, float, float] | None = None,
    shard_images: int = SHARD_IMAGES,
    reading: Mapping[str, Any] | None = None,
    engine: str = "local",
    workers: int = 1,
    on_image: OnImage | None = None,
    on_skip: OnSkip | None = None,
    on_wait: OnWait | None = None,
) -> Dataset:
    """Make a dataset: every source picture under its lights.

    Parameters
    ----------
    lut
        The table.
    out
        Where the dataset is to be, a folder or a URL of a store that fsspec knows; must be free. It appears when it is
        complete. What an earlier call with the same plan left there is gone on with.
    sources
        The pictures; see `scene`.
    lights
        Which lights fall on which picture; see `illuminant`. A sequence of numbers is the same for every picture.
    seed
        0 … 2⁶⁴ − 1; chooses the samples of every pixel.
    form, layout, previews, split, shard_images, reading
        See `production.plan.Options`; `reading` is its `sources`.
    engine
        Who does the work; see `production.engines.parse_engine`. No byte depends on it.
    workers
        Threads, or processes of a cluster on this machine; at most about three pictures are in memory for each.
    on_image, on_skip
        Called after each image, and for each source that cannot be read, from the calling thread.
    on_wait
        Called with a sentence for the user when nothing is made until somebody does something.

    Raises
    ------
    InputError
        A light is not in the table, an option is of another kind, the place is taken or belongs to another plan, or
        there is no source.
    FormatError
        None of the sources can be read.
    StorageError
        The disk is full, read-only or gone; the shards that are done are kept for the next call.
    """
    choice: LightChoice = lights if isinstance(lights, LightChoice) else ListedLights(tuple(lights))
    try:
        options = Options(
            form=form,
            layout=layout,
            previews=previews,
            split=split,
            shard_images=shard_images,
            sources=dict(reading or {}),
        )
    except ValidationError as error:
        first = error.errors()[0]
        option = ".".join(map(str, first["loc"]))
        raise InputError(f"{option} of a dataset is {first['input']!r}: {first['msg']}; see Options") from error
    plan = Plan(lut, sources, choice, seed, options)
    return make_dataset(plan, out, engine=engine, workers=workers, on_image=on_image, on_skip=on_skip, on_wait=on_wait)


def make_dataset(
    plan: Plan,
    out: Path | str,
    *,
    engine: str = "local",
    workers: int = 1,
    on_done: OnDone | None = None,
    on_image: OnImage | None = None,
    on_skip: OnSkip | None = None,
    on_wait: OnWait | None = None,
) -> Dataset:
    """Make the dataset of a plan, or go on with it; parameters and errors as of `generate_dataset`.

    `on_done` is told how many of the planned images were there already.
    """
    check_workers(engine, workers)
    identity = plan.identity()
    if not finished(out, identity):
        with workplace(out, identity) as place:
            _make(plan, place, range(plan.shards), engine, workers, on_done, on_image, on_skip, on_wait)
            try:
                assemble(place, identity)
            except NothingMadeError:
                place.discard()
                raise
    return open_dataset(out)


def make_share(
    plan: Plan,
    out: Path | str,
    share: tuple[int, int],
    *,
    engine: str = "local",
    workers: int = 1,
    on_done: OnDone | None = None,
    on_image: OnImage | None = None,
    on_skip: OnSkip | None = None,
    on_wait: OnWait | None = None,
) -> tuple[int, int]:
    """Make one of several shares of a dataset, beside other programs that make theirs; `finish_dataset` ends it.

    Parameters
    ----------
    share
        (i, n): the shards whose number leaves i when divided by n, i from 0.

    Returns
    -------
    tuple
        How many shards of the whole dataset are done now, and how many there are.
    """
    check_workers(engine, workers)
    index, count = share
    if not 0 <= index < count:
        raise InputError(f"share {index} of {count} was asked for, expected 0 to {count - 1}")
    with workplace(out, plan.identity(), alone=False) as place:
        _make(plan, place, range(index, plan.shards, count), engine, workers, on_done, on_image, on_skip, on_wait)
        return len(place.done()), plan.shards


def finish_dataset(out: Path | str) -> Dataset:
    """Make a dataset of its shards when every share is done.

    Raises
    ------
    InputError
        No dataset is being made there, shards are missing, or another program is at it.
    """
    identity = stored_identity(out)
    if not finished(out, identity):
        with workplace(out, identity) as place:
            missing = sorted(set(range(identity["shards"])) - place.done())
            if missing:
                raise InputError(
                    f"{len(missing)} of {identity['shards']} shards of {out} are not made yet: {first_of(missing)}; "
                    "run their shares, or the command without a share, which makes all that is missing"
                )
            assemble(place, identity)
    return open_dataset(out)


def _make(
    plan: Plan,
    place: Workplace,
    wanted: range,
    engine: str,
    workers: int,
    on_done: OnDone | None,
    on_image: OnImage | None,
    on_skip: OnSkip | None,
    on_wait: OnWait | None,
) -> None:
    done = place.done()
    missing = [shard for shard in wanted if shard not in done]
    if on_done is not None:
        on_done(sum(plan.images_of(shard) for shard in wanted if shard in done))
    make_shards(engine, plan, missing, place, workers, on_image or _ignore, on_skip or _ignore, on_wait or _ignore)


def _ignore(*told: object) -> None:
    del told
