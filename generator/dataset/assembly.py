"""From the records of all shards to a dataset: its tables, its description, its hashes.

Records are read one after the other and nothing of them is kept that grows with the dataset, so a million images take
no more memory than a thousand.
"""

from __future__ import annotations

import csv
import hashlib
import io
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack
from typing import Any

from foundation.errors import FormatError
from foundation.hashing import HashingWriter
from foundation.version import software
from generator.dataset.cards import card, croissant, datasheet
from generator.dataset.records import (
    CARD,
    COMPLETED_BY_HAND,
    CROISSANT,
    DATASHEET,
    GROUND_TRUTH,
    GROUND_TRUTH_COLUMNS,
    IMAGES,
    SOURCE_COLUMNS,
    SOURCES,
    SPLITS,
    STRETCHED_VERSION,
    SUMS,
    TRUTHS,
    VERSION,
    Description,
    Details,
    ImageRecord,
    Light,
    RenderingSummary,
    ShardRecord,
    Skipped,
    SourceRecord,
    TableRecord,
    image_key,
)
from generator.dataset.workplace import Workplace
from generator.files import suffix_of
from generator.stores import DESCRIPTION, Store


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


def assemble(place: Workplace, identity: Mapping[str, Any]) -> None:
    """Write what a dataset has beside its images, and give the dataset its name."""
    options = identity["options"]
    suffix = suffix_of(options["format"])
    counts: Counter[str] = Counter()
    splits: Counter[str] = Counter()
    skipped: list[Skipped] = []
    used: dict[int, Light] = {}
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
        table.write(_row(GROUND_TRUTH_COLUMNS))
        listed.write(_row(SOURCE_COLUMNS))
        for record, fresh, left_out in _records(place, int(identity["shards"])):
            names = {source.position: source for source in record.sources}
            for source in fresh:
                listed.write(_source_row(source))
                counts["sources"] += 1
                counts["pixels"] += source.width * source.height * int(options.get("crops", 1))
                counts["replaced"] += source.replaced_pixels
            skipped += left_out
            for image in record.images:
                source = names[image.position]
                name = f"{image_key(image.number)}{suffix}"
                table.write(_image_rows(name, source.name, image))
                truths.write("{:.9f} {:.9f} {:.9f}\n".format(*image.truth))
                if image.details:
                    rendered.add(image.details, source.width * source.height)
                    if details is None:
                        details = _ListedFile(stack, place.files, IMAGES)
                        details.write(_row(("image", *image.details)))
                    details.write(_row((name, *map(_plain, image.details.values()))))
                if source.split is not None:
                    parts[source.split].write(f"{name}\n")
                    splits[source.split] += 1
                counts["images"] += 1
            for file in record.files:
                sums.write(f"{file.sha256}  {file.name}\n".encode())
            used.update((light.illumination, light) for light in record.lights)
        if not counts["images"]:
            raise NothingMadeError(
                f"none of the {identity['sources']['count']} pictures can be used: all were "
                "left out, each with its reason; name others, or ask for a smaller crop if they are too small"
            )
        description = Description(
            version=STRETCHED_VERSION if options.get("scale") == "full" else VERSION,
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
        known = {file.name: file.sha256 for file in written}
        _write_cards(place, description, known)
    names = [file.name for file in written]
    place.files.sync([*names, SUMS, *COMPLETED_BY_HAND])
    # In an object store this makes it a dataset, so everything else is there.
    place.files.put(DESCRIPTION, text)
    place.files.sync([DESCRIPTION])
    place.publish()


def _write_cards(place: Workplace, description: Description, sums: Mapping[str, str]) -> None:
    """Write what people and catalogues read of the dataset; its makers complete it, so that no hash is recorded."""
    texts = {CARD: card(description), DATASHEET: datasheet(description), CROISSANT: croissant(description, sums)}
    for name, text in texts.items():
        place.files.put(name, text.encode())


def _records(place: Workplace, shards: int) -> Iterator[tuple[ShardRecord, list[SourceRecord], list[Skipped]]]:
    """Yield each shard's record, and those of its sources that no shard before had."""
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


def _row(fields: Iterable[object]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerow(fields)
    return text.getvalue()


def _plain(value: float | str) -> str:
    """Return a value of `images.csv`; nine digits give back every float32."""
    return f"{value:.9g}" if isinstance(value, float) else str(value)


def _source_row(source: SourceRecord) -> str:
    known = (source.position, source.name, source.sha256 or "", source.width, source.height, source.replaced_pixels)
    return _row((*known, source.split or "", source.profile or ""))


def _image_rows(name: str, source: str, image: ImageRecord) -> str:
    return "".join(
        _row((name, source, light.illumination, *(f"{part:.9f}" for part in light.truth))) for light in image.lights
    )
