"""Making a dataset: whole, in shares beside other programs, out of the shards of all shares; and who may work at it.

Shards (`generator.dataset.shards`) are made by threads of this program, or by the workers of a Dask cluster. Either
takes the shards that are not done and returns when they are, whatever died meanwhile.

Rules that hold inside, of the place where a dataset is made (`shards.Workplace`):

- A place belongs to one plan. Another plan is refused with a message that says how the two differ. A worker of a plan
  that was removed may still be alive: its records bear the identifier of its plan, so they are never taken for ours.
- A program that makes the whole dataset locks the folder alone; programs that make shares of it share the lock.
- A place without a finished image is of no use later and is removed when the work fails; so is one without a finished
  shard where the command is at fault, which has to be another then.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import re
import shutil
import threading
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any, Final, cast

from foundation.errors import CropError, DeviceError, FormatError, InputError
from foundation.files import partial_path, storage_error
from foundation.folders import clear_folder, locked_folder, require_free
from generator.dataset.plan import DatasetOptions, Plan
from generator.dataset.reader import Dataset, load_description, open_dataset
from generator.dataset.shards import (
    NOTES,
    PLAN,
    SILENT,
    Callbacks,
    NothingMadeError,
    PlanIdentity,
    ShardCancelled,
    ShardDone,
    Workplace,
    assemble,
    make_elsewhere,
    make_shard,
    remove_notes,
)
from generator.lights.choices import listed_lights
from generator.lights.lighting import LightChoice, Mixture
from generator.pictures.sources import Source, changed_sha256
from generator.stores import DESCRIPTION, LocalStore, RemoteStore, Store, is_remote, local_path, open_store

if TYPE_CHECKING:
    import distributed

    from calibration.table.lut import Lut
    from generator.rendering import Rendering


@dataclass(frozen=True)
class Workers:
    """Who makes the shards; no byte of the dataset depends on it.

    Attributes
    ----------
    engine
        ``local``, ``dask`` or ``dask://HOST:PORT``; see `parse_engine`.
    count
        Threads, or processes of a cluster on this machine, 1 or more; each has at most about three pictures in memory.
        A cluster that is named has its own.

    Raises
    ------
    InputError
        There is no such engine, or no worker.

    Examples
    --------
    >>> Workers(count=4)
    Workers(engine='local', count=4)
    >>> Workers("dask://10.0.0.7:8786").address
    'tcp://10.0.0.7:8786'
    """

    engine: str = "local"
    count: int = 1

    def __post_init__(self) -> None:
        if self.count < 1:
            raise InputError(f"{self.count} workers were asked for, expected 1 or more")
        parse_engine(self.engine)

    @property
    def address(self) -> str | None:
        """The scheduler's address, as `parse_engine` returns it."""
        return parse_engine(self.engine)


def parse_engine(text: str) -> str | None:
    """Return the address of the Dask scheduler that an engine's name asks for.

    Returns `tcp://HOST:PORT`; empty for a cluster on this machine; None for threads of this program.
    """
    if text == "local":
        return None
    if text == "dask":
        return ""
    match = re.fullmatch(r"dask://([^/\s]+:\d+)/?", text)
    if not match:
        raise InputError(f"{text!r} is no engine; use local, dask, or dask://HOST:PORT of a Dask scheduler")
    return f"tcp://{match[1]}"


def parse_share(text: str) -> tuple[int, int]:
    """Return (i, n) of a text such as `3/16`: share i of n, i from 0."""
    match = re.fullmatch(r"(\d{1,9})/(\d{1,9})", text.strip(), re.ASCII)
    if not match or not int(match[1]) < int(match[2]):
        raise InputError(f"{text!r} is no share; write I/N with I from 0 to N - 1, such as 0/16")
    return int(match[1]), int(match[2])


# How often a shard is submitted at most. Dask gives a task up once it was on four workers that died; after five times
# four it is the shard, and no accident, that kills them.
ATTEMPTS: Final = 5

# How long a scheduler may take to answer, s: one that runs answers in milliseconds, also on a busy network.
CONNECT_S: Final = 10.0

_Event = Callable[[], None]


def _by_threads(plan: Plan, shards: Sequence[int], place: Workplace, workers: int, callbacks: Callbacks) -> None:
    """Make two shards at a time, so that the threads have work while one of the two is being finished."""
    events: SimpleQueue[_Event | None] = SimpleQueue()
    cancelled = threading.Event()
    waiting = iter(shards)
    taking = threading.Lock()
    at_once = min(2, len(shards), workers)
    depth = -(-workers // at_once)
    queued = Callbacks(
        on_done=lambda images: events.put(partial(callbacks.on_done, images)),
        on_image=lambda: events.put(callbacks.on_image),
        on_skip=lambda name, reason, images: events.put(partial(callbacks.on_skip, name, reason, images)),
    )

    def drive(pool: ThreadPoolExecutor) -> None:
        def fail(error: BaseException) -> None:
            raise error

        try:
            while not cancelled.is_set():
                with taking:
                    shard = next(waiting, None)
                    if shard is None:
                        return
                    job = plan.job(shard)
                make_shard(job, plan.lut, place, pool, depth, queued, cancelled)
        except ShardCancelled:
            pass
        except BaseException as error:
            events.put(partial(fail, error))
        finally:
            events.put(None)

    with ThreadPoolExecutor(workers) as pool, ThreadPoolExecutor(at_once) as drivers:
        driving = [drivers.submit(drive, pool) for _ in range(at_once)]
        try:
            for _ in driving:
                while (event := events.get()) is not None:
                    event()
        finally:
            cancelled.set()


def _by_dask(
    address: str, plan: Plan, shards: Sequence[int], place: Workplace, workers: int, callbacks: Callbacks
) -> None:
    try:
        from distributed import KilledWorker, as_completed
    except ImportError as error:
        raise InputError("the engine dask needs Dask; install it with: pip install dask distributed") from error

    attempts = dict.fromkeys(shards, 0)
    waiting: Iterator[int] = iter(shards)
    with _client(address, workers) as client:

        def submit(shard: int) -> distributed.Future[ShardDone]:
            attempts[shard] += 1
            key = f"crop-shard-{shard}-{attempts[shard]}-{plan.seed}-{id(plan)}"
            return client.submit(make_elsewhere, plan.job(shard), place, key=key, pure=False)

        threads = client.nthreads()
        if not threads:
            callbacks.on_wait(f"the Dask scheduler has no worker yet; start some with: dask worker {address}")
        # A few tasks a thread are handed out at a time: a plan may have more of them than memory has room for.
        at_once = max(4, 3 * sum(threads.values()))
        running = {submit(shard): shard for shard in islice(waiting, at_once)}
        futures = as_completed(list(running), loop=client.loop)
        for future in futures:
            shard = running.pop(future)
            try:
                done = future.result()
            except KilledWorker as error:
                if attempts[shard] >= ATTEMPTS:
                    raise DeviceError(
                        f"shard {shard} was on {4 * ATTEMPTS} workers when they died; give the workers more memory or "
                        "make shards smaller, then run the same command again to go on"
                    ) from error
                again = submit(shard)
                running[again] = shard
                futures.add(again)
                continue
            except CropError:
                raise
            except Exception as error:
                if future.status in ("cancelled", "lost"):
                    raise DeviceError(
                        f"the Dask cluster {address or 'of this machine'} was lost; start it again, then run the same "
                        "command again to go on"
                    ) from error
                raise
            for skipped in done.skipped:
                callbacks.on_skip(*skipped)
            if done.found:
                callbacks.on_done(done.found)
            for _ in range(done.images - done.found):
                callbacks.on_image()
            following = next(waiting, None)
            if following is not None:
                future = submit(following)
                running[future] = following
                futures.add(future)


@contextmanager
def _client(address: str, workers: int) -> Generator[distributed.Client]:
    from distributed import Client, LocalCluster

    if address:
        try:
            client = Client(address, timeout=CONNECT_S, set_as_default=False)
        except OSError as error:
            raise InputError(
                f"no Dask scheduler answers at {address.removeprefix('tcp://')}: {error}; start one with "
                "dask scheduler, or give its address"
            ) from error
        with client:
            yield client
        return
    try:
        cluster = LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            dashboard_address="127.0.0.1:0",
            memory_limit=None,
            silence_logs=logging.CRITICAL,
        )
    except RuntimeError as error:
        raise DeviceError(
            f"the Dask cluster of this machine cannot be started ({error}): a worker died at once; run the same "
            "command again to go on, or with fewer --workers"
        ) from error
    with cluster, Client(cluster, set_as_default=False) as client:
        yield client


def generate_dataset(
    lut: Lut,
    out: Path | str,
    sources: Sequence[Source],
    lights: LightChoice | Sequence[int | str | Mixture],
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
        The same lights for every picture, each a number in the table, a text as the command's ``--light`` takes it
        (``"5600K"``, ``"D65"``, ``"12:0.25+40:0.75"``), or a mixture; or a choice of `generator.lights.choices`, which
        says which lights fall on which picture.
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
        The disk is full, read-only or gone; the images that are finished are kept for the next call.

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
    choice: LightChoice = lights if isinstance(lights, LightChoice) else listed_lights(lights, lut)
    plan = Plan(lut, sources, choice, seed, options or DatasetOptions())
    return make_dataset(plan, out, workers if isinstance(workers, Workers) else Workers(count=workers), callbacks)


def make_dataset(plan: Plan, out: Path | str, workers: Workers | None = None, callbacks: Callbacks = SILENT) -> Dataset:
    """Make the dataset of a plan, or continue it; parameters and errors as of `generate_dataset`.

    One thread makes it if `workers` is None.
    """
    identity = plan.identity()
    if finished(out, identity):
        return open_dataset(out)
    with workplace(out, identity) as place:
        _make(plan, place, range(plan.shards), workers or Workers(), callbacks)
        try:
            return assemble(place, identity)
        except NothingMadeError:
            place.discard()
            raise


def begun_rendering(out: Path | str) -> Rendering | None:
    """Return how the dataset is rendered that is at `out`, or was begun there; None where there is none."""
    if holds_dataset(out):
        options: Mapping[str, Any] = load_description(open_store(out)).options
    elif is_begun(out):
        options = stored_identity(out)["options"]
    else:
        return None
    return "codes" if options.get("rendering") is None else "colorimetric"


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
    known = {source.position: (source.name, source.sha256) for source in dataset.sources}
    known |= {skipped.position: (skipped.name, None) for skipped in dataset.description.skipped}
    if len(known) != len(plan.sources):
        return [f"sources {len(known)}, now {len(plan.sources)}"]
    since = None if is_remote(str(out)) else (local_path(out) / DESCRIPTION).stat().st_mtime
    for place, source in enumerate(plan.sources):
        name, sha256 = known.get(place, ("", None))
        if source.name != name:
            return [f"source {place} {name}, now {source.name}"]
        if sha256 is not None and since is not None and changed_sha256(source, since) not in (None, sha256):
            return [f"the content of {name}"]
    return []


def make_share(
    plan: Plan,
    out: Path | str,
    share: tuple[int, int],
    workers: Workers | None = None,
    callbacks: Callbacks = SILENT,
) -> tuple[int, int]:
    """Make one of several shares of a dataset, beside other programs that make theirs; then call `make_dataset`.

    `share`: (i, n): the shards whose number leaves i when divided by n, i from 0.
    """
    index, count = share
    if not 0 <= index < count:
        raise InputError(f"share {index} of {count} was asked for, expected 0 to {count - 1}")
    with workplace(out, plan.identity(), alone=False) as place:
        _make(plan, place, range(index, plan.shards, count), workers or Workers(), callbacks)
        return place.count_done(), plan.shards


def _make(plan: Plan, place: Workplace, wanted: range, workers: Workers, callbacks: Callbacks) -> None:
    done = place.done(wanted)
    missing = [shard for shard in wanted if shard not in done]
    callbacks.on_done(sum(map(plan.images_of, done)))
    if not missing:
        return
    if workers.address is None:
        _by_threads(plan, missing, place, workers.count, callbacks)
    else:
        _by_dask(workers.address, plan, missing, place, workers.count, callbacks)


def finished(out: str | Path, identity: PlanIdentity) -> bool:
    """Return whether the dataset of this plan is complete; notes that a killed program left are removed then."""
    notes = _notes(out)
    if not open_store(out).has(DESCRIPTION):
        return False
    planned = notes.has(PLAN)
    if planned and differences(_load(notes), identity):
        return False
    remove_notes(notes)
    return planned


def require_free_place(out: str | Path) -> None:
    """Raise an InputError if `out` is taken, so that a command can say so before it does any work."""
    if is_begun(out):
        return
    if isinstance(out, str) and is_remote(out):
        if RemoteStore(out).has(DESCRIPTION):
            raise InputError(f"{out} already holds a dataset; name another place, or remove what is there")
    else:
        require_free(local_path(out), "the dataset")


def holds_dataset(out: str | Path) -> bool:
    """Return whether a dataset is complete at `out`, and no plan lies there that its making was ended by."""
    return open_store(out).has(DESCRIPTION) and not is_begun(out)


def is_begun(out: str | Path) -> bool:
    """Return whether a plan lies at `out` of a dataset that is being made, or was before its program ended."""
    return _notes(out).has(PLAN)


def differences(stored: Any, wanted: Any) -> list[str]:
    """Return each difference of two plans, or of parts of them, in words."""
    return list(_differences(stored, json.loads(json.dumps(wanted))))


@contextmanager
def workplace(out: str | Path, identity: PlanIdentity, alone: bool = True) -> Generator[Workplace]:
    """Open the place where the dataset `out` is being made, or begin one."""
    if isinstance(out, str) and is_remote(out):
        yield from _remote(out, identity)
        return
    path = local_path(out)
    require_free(path, "the dataset")
    # Whole, since a worker may have been started in another folder.
    folder = partial_path(path).absolute()
    busy = f"{path} is being made by another program; wait for it, or name another place"
    planned = None if alone else (folder / "plan" / PLAN).is_file
    with locked_folder(folder, busy, share_if=planned, target=path) as lock:
        notes = LocalStore(folder / "plan")
        plan_id = _plan_id(identity)
        place = Workplace(LocalStore(folder / f"dataset-{plan_id}"), notes, str(path), plan_id)
        is_begun = notes.has(PLAN)
        if is_begun:
            # What another plan has made stays, so that the command that began it can finish it.
            _require_same(notes, identity, path, f"remove {folder}")
        try:
            if not is_begun:
                _require_still_free(path, folder)
                _begin(folder, plan_id)
                notes.put(PLAN, _text(identity))
                notes.sync([PLAN])
            if not alone:
                lock.share()
            yield place
        except BaseException as error:
            # An InputError asks for another command, which could not go on with images of this one.
            if alone and folder.is_dir() and not place.has_finished(isinstance(error, InputError)):
                shutil.rmtree(folder, ignore_errors=True)
            raise


def stored_identity(out: str | Path) -> PlanIdentity:
    """Return the identity of the plan of a dataset that is being made."""
    notes = _notes(out)
    if not notes.has(PLAN):
        raise InputError(f"no dataset is being made at {out}; begin one with generate")
    return _load(notes)


def _notes(out: str | Path) -> Store:
    if isinstance(out, str) and is_remote(out):
        return RemoteStore(f"{out.rstrip('/')}/{NOTES}")
    return LocalStore(partial_path(local_path(out)) / "plan")


def _remote(out: str, identity: PlanIdentity) -> Generator[Workplace]:
    files, notes = RemoteStore(out), RemoteStore(f"{out.rstrip('/')}/{NOTES}")
    place = Workplace(files, notes, out, _plan_id(identity))
    if files.has(DESCRIPTION):
        raise InputError(f"{out} already holds a dataset; name another place, or remove what is there")
    begun = notes.has(PLAN)
    if not begun:
        if next(files.names(), None) is not None:
            raise InputError(f"{out} already holds something else; name another place, or remove what is there")
        notes.put(PLAN, _text(identity))
    _require_same(notes, identity, out, f"remove what is below {out}")
    try:
        yield place
    except BaseException:
        with contextlib.suppress(Exception):
            if not begun and not place.has_finished():
                files.remove("")
        raise


def _require_still_free(path: Path, folder: Path) -> None:
    """Refuse when another program finished the dataset while its hold was waited for; `folder` is then new."""
    try:
        require_free(path, "the dataset")
    except InputError:
        shutil.rmtree(folder, ignore_errors=True)
        raise


def _begin(folder: Path, plan_id: str) -> None:
    """Make the folders inside; files that are there without a plan are left from before the plan was written."""
    try:
        clear_folder(folder)
        for inner in ("plan", f"dataset-{plan_id}"):
            (folder / inner).mkdir()
    except OSError as error:
        raise storage_error(folder, error) from error


def _text(identity: PlanIdentity) -> bytes:
    return (json.dumps(identity, indent=1) + "\n").encode()


def _plan_id(identity: PlanIdentity) -> str:
    """Return the first 16 hexadecimal digits of the SHA-256 of the plan's identity."""
    return hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()[:16]


def _load(notes: Store) -> dict[str, Any]:
    try:
        loaded = json.loads(notes.get(PLAN))
    except ValueError as error:
        raise FormatError(f"{notes.place}/{PLAN} is damaged; remove it and all beside it, then begin anew") from error
    return dict(loaded)


def _require_same(notes: Store, identity: PlanIdentity, out: str | Path, remedy: str) -> None:
    differing = differences(_load(notes), identity)
    if differing:
        raise InputError(
            f"{out} was begun with another plan ({'; '.join(differing)}); finish it as it was begun, {remedy}, or name "
            "another place"
        )


def _differences(stored: Any, wanted: Any, name: str = "") -> Generator[str]:
    if isinstance(stored, dict) and isinstance(wanted, dict):
        one, other = cast("dict[str, Any]", stored), cast("dict[str, Any]", wanted)
        for key in dict.fromkeys([*one, *other]):
            # "lights", not "options lights lights".
            inner = name if key in ("options", name.rpartition(" ")[2]) else f"{name} {key}".strip()
            yield from _differences(one.get(key), other.get(key), inner)
    elif stored != wanted:
        yield f"{name} {_short(stored)}, now {_short(wanted)}"


def _short(value: Any, most: int = 40) -> str:
    text = json.dumps(value)
    return text if len(text) <= most else f"{text[:most]}…"
