"""Making a dataset: whole, in shares beside other programs, and out of the shards of all shares."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from foundation.errors import InputError, first_of
from generator.dataset.production.assembly import NothingMadeError, assemble
from generator.dataset.production.engines import make_shards
from generator.dataset.production.options import DatasetOptions
from generator.dataset.production.plan import Plan
from generator.dataset.production.workers import SILENT, Callbacks, Workers
from generator.dataset.production.workplace import (
    Workplace,
    differences,
    finished,
    holds_dataset,
    stored_identity,
    workplace,
)
from generator.dataset.reader import Dataset, open_dataset
from generator.lights.choices import ListedLights
from generator.lights.lighting import LightChoice
from generator.pictures.sources import hash_since
from generator.stores.places import DESCRIPTION, is_remote, local_path

if TYPE_CHECKING:
    from calibration.table.lut import Lut
    from generator.pictures.sources import Source

__all__ = [
    "Callbacks",
    "DatasetOptions",
    "Plan",
    "Workers",
    "finish_dataset",
    "generate_dataset",
    "made_before",
    "make_dataset",
    "make_share",
]


def generate_dataset(
    lut: Lut,
    out: Path | str,
    sources: Sequence[Source],
    lights: LightChoice | Sequence[int],
    *,
    seed: int = 0,
    options: DatasetOptions | None = None,
    workers: Workers | int = 1,
    callbacks: Callbacks = SILENT,
) -> Dataset:
    """Make a dataset: every source picture under its lights.

    Parameters
    ----------
    lut
        The table.
    out
        Where the dataset is to be, a folder or a URL of a store that fsspec knows; must be free. It appears when it is
        complete. The work of an earlier call with the same plan that was interrupted is continued.
    sources
        The pictures; see `generator.pictures.sources`.
    lights
        Which lights fall on which picture; see `generator.lights.choices`. A sequence of numbers of the table's lights
        is the same for every picture.
    seed
        0 … 2⁶⁴ − 1; chooses the samples of every pixel.
    options
        File format, layout, previews, split and shards; the defaults of `DatasetOptions` if None.
    workers
        Who does the work; a number is that of threads. No byte depends on it.
    callbacks
        What is called after each image, for each source that cannot be read, and where the work waits.

    Returns
    -------
    Dataset
        The dataset, opened.

    Raises
    ------
    InputError
        A light is not in the table, the place is taken or belongs to another plan, or there is no source.
    FormatError
        None of the sources can be read.
    StorageError
        The disk is full, read-only or gone; the shards that are done are kept for the next call.

    Examples
    --------
    >>> import tempfile
    >>> from generator import DatasetOptions, find_pictures, generate_dataset, open_lut
    >>> lut, options = open_lut("lut"), DatasetOptions(form="tiff", previews=False)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     place = f"{folder}/dataset"
    ...     made = generate_dataset(lut, place, find_pictures("cat.png"), [0, 3], options=options, workers=2)
    ...     [(entry.image, entry.source, entry.illumination) for entry in made.entries]
    [('000000.tiff', 'cat.png', '0'), ('000001.tiff', 'cat.png', '3')]
    """
    choice: LightChoice = lights if isinstance(lights, LightChoice) else ListedLights(tuple(lights))
    plan = Plan(lut, sources, choice, seed, options or DatasetOptions())
    return make_dataset(plan, out, workers if isinstance(workers, Workers) else Workers(count=workers), callbacks)


def make_dataset(plan: Plan, out: Path | str, workers: Workers | None = None, callbacks: Callbacks = SILENT) -> Dataset:
    """Make the dataset of a plan, or continue it; parameters and errors as of `generate_dataset`.

    One thread makes it if `workers` is None.
    """
    identity = plan.identity()
    if not finished(out, identity):
        with workplace(out, identity) as place:
            _make(plan, place, range(plan.shards), workers or Workers(), callbacks)
            try:
                assemble(place, identity)
            except NothingMadeError:
                place.discard()
                raise
    return open_dataset(out)


def made_before(plan: Plan, out: Path | str) -> Dataset | None:
    """Return the dataset at `out` if it is complete and of this very plan; None where there is no complete one.

    Pictures on this machine that were written to since are hashed again and compared; those on a store are compared by
    their names.
    """
    if not holds_dataset(out):
        return None
    dataset = open_dataset(out)
    made, identity = dataset.description, plan.identity()
    stored = {
        "software": made.software,
        "libraries": made.libraries,
        "table": made.table.model_dump(mode="json"),
        "seed": made.seed,
        "options": made.options,
        "images": made.planned,
    }
    differing = differences(stored, {key: identity[key] for key in stored}) or _other_pictures(dataset, plan, out)
    if differing:
        raise InputError(
            f"{out} holds a dataset that this command would make otherwise ({'; '.join(differing)}); name another "
            "place, or remove what is there"
        )
    return dataset


def _other_pictures(dataset: Dataset, plan: Plan, out: Path | str) -> list[str]:
    """Return in words a picture of the plan that the dataset was not made of."""
    known = {source.position: (source.name, source.sha256) for source in dataset.sources}
    known |= {skipped.position: (skipped.name, None) for skipped in dataset.description.skipped}
    if len(known) != len(plan.sources):
        return [f"sources {len(known)}, now {len(plan.sources)}"]
    since = None if is_remote(str(out)) else (local_path(out) / DESCRIPTION).stat().st_mtime
    for place, source in enumerate(plan.sources):
        name, sha256 = known.get(place, ("", None))
        if source.name != name:
            return [f"source {place} {name}, now {source.name}"]
        if sha256 is not None and since is not None and hash_since(source, since) not in (None, sha256):
            return [f"the content of {name}"]
    return []


def make_share(
    plan: Plan,
    out: Path | str,
    share: tuple[int, int],
    workers: Workers | None = None,
    callbacks: Callbacks = SILENT,
) -> tuple[int, int]:
    """Make one of several shares of a dataset, beside other programs that make theirs; then call `finish_dataset`.

    `share`: (i, n): the shards whose number leaves i when divided by n, i from 0.
    """
    index, count = share
    if not 0 <= index < count:
        raise InputError(f"share {index} of {count} was asked for, expected 0 to {count - 1}")
    with workplace(out, plan.identity(), alone=False) as place:
        _make(plan, place, range(index, plan.shards, count), workers or Workers(), callbacks)
        return len(place.done()), plan.shards


def finish_dataset(out: Path | str) -> Dataset:
    """Make a dataset of its shards when every share is done; a dataset that is complete stays as it is."""
    if holds_dataset(out):
        return open_dataset(out)
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


def _make(plan: Plan, place: Workplace, wanted: range, workers: Workers, callbacks: Callbacks) -> None:
    done = place.done()
    missing = [shard for shard in wanted if shard not in done]
    callbacks.on_done(sum(plan.images_of(shard) for shard in wanted if shard in done))
    make_shards(plan, missing, place, workers, callbacks)
