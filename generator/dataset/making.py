"""Generate data sets: complete, or in shares by several programs; share i of n has the shards with number mod n = i.

Threads of this program or workers of a Dask cluster make the shards (`generator.dataset.shards`). Contract of the
workplace, the folder or store location in which a data set is made (`shards.Workplace`):

- A workplace belongs to one plan. Another plan is refused, and the message lists the differences. Records have the
  identifier of their plan, because a worker of a removed plan may still be running.
- A program that makes the complete data set locks the folder exclusively. Programs that make shares can hold the
  lock together.
- If the work fails before an image is finished, the workplace is removed. After an `InputError`, the command must be
  changed; the workplace is then removed unless a shard is complete.
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

from foundation.errors import RUN_AGAIN, CropError, DeviceError, FormatError, InputError
from foundation.files import partial_path, storage_error
from foundation.folders import clear_folder, locked_folder, require_free
from foundation.remote import is_remote
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
    make_shard,
    make_shard_on_worker,
    remove_notes,
)
from generator.lights.choices import listed_lights
from generator.lights.lighting import LightChoice, Mixture
from generator.pictures.sources import Source, changed_sha256
from generator.stores import DESCRIPTION, LocalStore, RemoteStore, Store, local_path, open_store

if TYPE_CHECKING:
    import distributed

    from calibration.table.lut import Lut
    from generator.rendering import Rendering


@dataclass(frozen=True)
class Workers:
    """Workers that make the shards; the bytes of the data set do not depend on them.

    Attributes
    ----------
    engine
        ``"local"`` for threads, ``"dask"`` for a cluster on this machine, or ``"dask://HOST:PORT"`` of a scheduler.
    count
        Number of threads, or of processes of a cluster on this machine, 1 or more. Each keeps about three pictures in
        memory. Ignored for an existing cluster.

    Raises
    ------
    InputError
        The engine or the number is invalid.

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
            raise InputError(f"the number of workers is {self.count}, expected 1 or more; correct it")
        parse_engine(self.engine)

    @property
    def address(self) -> str | None:
        """Address of the scheduler; see `parse_engine`."""
        return parse_engine(self.engine)


def parse_engine(text: str) -> str | None:
    """Return the address of the Dask scheduler of an engine.

    It is ``tcp://HOST:PORT``, empty for a cluster on this machine, or None for threads of this program.
    """
    if text == "local":
        return None
    if text == "dask":
        return ""
    match = re.fullmatch(r"dask://([^/\s]+:\d+)/?", text)
    if not match:
        raise InputError(
            f"the engine is {text!r}, expected local, dask, or dask://HOST:PORT of a Dask scheduler; correct it"
        )
    return f"tcp://{match[1]}"


def parse_share(text: str) -> tuple[int, int]:
    """Return (i, n) of a text such as `3/16`, which means share i of n, with i from 0."""
    match = re.fullmatch(r"(\d{1,9})/(\d{1,9})", text.strip(), re.ASCII)
    if not match or not int(match[1]) < int(match[2]):
        raise InputError(f"the share is {text!r}, expected I/N with I from 0 to N - 1, such as 0/16; correct it")
    return int(match[1]), int(match[2])


# Largest number of submissions of a shard. Dask gives up a task when four workers have died during it. After five
# submissions, the shard itself is the probable cause.
ATTEMPTS: Final = 5

# Timeout for the scheduler in s; a running scheduler answers in milliseconds, even on a busy network.
CONNECT_S: Final = 10.0

_Event = Callable[[], None]


def _by_threads(plan: Plan, shards: Sequence[int], workplace: Workplace, workers: int, callbacks: Callbacks) -> None:
    # Two shards are made at the same time, so that no thread is idle while one of them is being completed.
    events: SimpleQueue[_Event | None] = SimpleQueue()
    cancelled = threading.Event()
    waiting = iter(shards)
    shard_lock = threading.Lock()
    parallel_shards = min(2, len(shards), workers)
    depth = -(-workers // parallel_shards)
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
                with shard_lock:
                    shard = next(waiting, None)
                    if shard is None:
                        return
                    job = plan.job(shard)
                make_shard(job, plan.lut, workplace, pool, depth, queued, cancelled)
        except ShardCancelled:
            pass
        except BaseException as error:
            events.put(partial(fail, error))
        finally:
            events.put(None)

    with ThreadPoolExecutor(workers) as pool, ThreadPoolExecutor(parallel_shards) as drivers:
        jobs = [drivers.submit(drive, pool) for _ in range(parallel_shards)]
        try:
            for _ in jobs:
                while (event := events.get()) is not None:
                    event()
        finally:
            cancelled.set()


def _by_dask(
    address: str, plan: Plan, shards: Sequence[int], workplace: Workplace, workers: int, callbacks: Callbacks
) -> None:
    try:
        from distributed import KilledWorker, as_completed
    except ImportError as error:
        raise InputError("the engine is dask, but Dask is not installed; run pip install dask distributed") from error

    attempts = dict.fromkeys(shards, 0)
    waiting: Iterator[int] = iter(shards)
    with _client(address, workers) as client:

        def submit(shard: int) -> distributed.Future[ShardDone]:
            attempts[shard] += 1
            key = f"crop-shard-{shard}-{attempts[shard]}-{plan.seed}-{id(plan)}"
            return client.submit(make_shard_on_worker, plan.job(shard), workplace, key=key, pure=False)

        threads = client.nthreads()
        if not threads:
            callbacks.on_wait(f"the Dask scheduler has 0 workers, expected 1 or more; run dask worker {address}")
        # Only a few tasks for each thread are submitted at once, because all tasks of a plan may exceed the memory.
        task_limit = max(4, 3 * sum(threads.values()))
        running = {submit(shard): shard for shard in islice(waiting, task_limit)}
        futures = as_completed(list(running), loop=client.loop)
        for future in futures:
            shard = running.pop(future)
            try:
                result = future.result()
            except KilledWorker as error:
                if attempts[shard] >= ATTEMPTS:
                    raise DeviceError(
                        f"{4 * ATTEMPTS} workers died while they made shard {shard}; give the workers more memory or "
                        f"make shards smaller, {RUN_AGAIN}"
                    ) from error
                retry = submit(shard)
                running[retry] = shard
                futures.add(retry)
                continue
            except CropError:
                raise
            except Exception as error:
                if future.status in ("cancelled", "lost"):
                    raise DeviceError(
                        f"the connection to the Dask cluster {address or 'of this machine'} was lost; start it again, "
                        f"{RUN_AGAIN}"
                    ) from error
                raise
            for skipped in result.skipped:
                callbacks.on_skip(*skipped)
            if result.reused:
                callbacks.on_done(result.reused)
            for _ in range(result.images - result.reused):
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
                f"no answer from a Dask scheduler at {address.removeprefix('tcp://')}: {error}; start one with "
                "dask scheduler, or correct the address"
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
            f"the Dask cluster of this machine cannot be started ({error}), because a worker died; use "
            f"fewer --workers, {RUN_AGAIN}"
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
    """Generate a data set: images of every source picture under its illuminants.

    Parameters
    ----------
    lut
        The look-up table (LUT); see `open_lut`.
    out
        New folder, or URL of a store that fsspec supports. It appears when the data set is complete. An interrupted
        call is resumed by a call with equal arguments.
    sources
        The source pictures; see `find_pictures`.
    lights
        The same illuminants for every picture, or a choice of `generator.lights.choices`. Each illuminant is a number
        in the LUT, a mixture, or a text as for ``--light`` (``"5600K"``, ``"D65"``, ``"12:0.25+40:0.75"``).
    seed
        Seed of all random choices, 0 … 2⁶⁴ − 1.
    options
        File format, layout, split and others; defaults of `DatasetOptions` if None.
    workers
        The workers, or the number of threads. The bytes of the data set do not depend on them.
    callbacks
        Functions called after each image, for each picture that cannot be read, and when the work waits.

    Returns
    -------
    Dataset
        The data set, opened.

    Raises
    ------
    InputError
        An illuminant is not in the LUT, `out` exists or belongs to another plan, or there are no sources.
    FormatError
        None of the sources can be read.
    StorageError
        The disk is full, read-only or missing; finished images are kept for the next call.

    Examples
    --------
    >>> import tempfile
    >>> from generator import DatasetOptions, find_pictures, generate_dataset, open_lut
    >>> lut, options = open_lut("lut"), DatasetOptions(form="tiff", previews=False)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     out = f"{folder}/dataset"
    ...     dataset = generate_dataset(lut, out, find_pictures("cat.png"), [0, 3], options=options, workers=2)
    ...     [(entry.image, entry.source, entry.illumination) for entry in dataset.entries]
    [('000000.tiff', 'cat.png', '0'), ('000001.tiff', 'cat.png', '3')]
    """
    choice: LightChoice = lights if isinstance(lights, LightChoice) else listed_lights(lights, lut)
    plan = Plan(lut, sources, choice, seed, options or DatasetOptions())
    return make_dataset(plan, out, workers if isinstance(workers, Workers) else Workers(count=workers), callbacks)


def make_dataset(plan: Plan, out: Path | str, workers: Workers | None = None, callbacks: Callbacks = SILENT) -> Dataset:
    """Make or resume the data set of a plan, with one thread if `workers` is None; see `generate_dataset`."""
    identity = plan.identity()
    if is_complete(out, identity):
        return open_dataset(out)
    with open_workplace(out, identity) as workplace:
        _make_missing(plan, workplace, range(plan.shards), workers or Workers(), callbacks)
        try:
            return assemble(workplace, identity)
        except NothingMadeError:
            workplace.discard()
            raise


def existing_rendering(out: Path | str) -> Rendering | None:
    """Return the rendering of the data set at `out`, complete or in progress; None if there is none."""
    if holds_dataset(out):
        options: Mapping[str, Any] = load_description(open_store(out)).options
    elif is_started(out):
        options = stored_identity(out)["options"]
    else:
        return None
    return "codes" if options.get("rendering") is None else "colorimetric"


def completed_dataset(plan: Plan, out: Path | str) -> Dataset | None:
    """Return the complete data set at `out`, or None if there is none; raises InputError if its plan differs.

    Pictures on this machine are hashed again if they were modified after the data set was completed. Pictures in a
    store are compared by name.
    """
    if not holds_dataset(out):
        return None
    dataset = open_dataset(out)
    description, identity = dataset.description, plan.identity()
    stored = {
        "software": description.software,
        "libraries": description.libraries,
        "table": description.table.model_dump(mode="json"),
        "seed": description.seed,
        "options": description.options,
        "images": description.planned,
    }
    differing = differences(stored, {key: identity[key] for key in stored}) or _differing_pictures(dataset, plan, out)
    if differing:
        raise InputError(
            f"{out} already contains a different data set ({'; '.join(differing)}); choose another location, or remove "
            "the data set"
        )
    return dataset


def _differing_pictures(dataset: Dataset, plan: Plan, out: Path | str) -> list[str]:
    recorded = {source.position: (source.name, source.sha256) for source in dataset.sources}
    recorded |= {skipped.position: (skipped.name, None) for skipped in dataset.description.skipped}
    if len(recorded) != len(plan.sources):
        return [f"sources {len(recorded)}, now {len(plan.sources)}"]
    since = None if is_remote(str(out)) else (local_path(out) / DESCRIPTION).stat().st_mtime
    for position, source in enumerate(plan.sources):
        name, sha256 = recorded.get(position, ("", None))
        if source.name != name:
            return [f"source {position} {name}, now {source.name}"]
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
    """Make share (i, n) of a data set: all shards with number mod n = i. Call `make_dataset` after the last share.

    Returns the number of complete shards and of all shards.
    """
    index, count = share
    if not 0 <= index < count:
        raise InputError(f"the share is {index} of {count}, expected 0 to {count - 1}; correct it")
    with open_workplace(out, plan.identity(), exclusive=False) as workplace:
        _make_missing(plan, workplace, range(index, plan.shards, count), workers or Workers(), callbacks)
        return workplace.count_done(), plan.shards


def _make_missing(plan: Plan, workplace: Workplace, shards: range, workers: Workers, callbacks: Callbacks) -> None:
    done_shards = workplace.done(shards)
    missing = [shard for shard in shards if shard not in done_shards]
    callbacks.on_done(sum(map(plan.images_of, done_shards)))
    if not missing:
        return
    if workers.address is None:
        _by_threads(plan, missing, workplace, workers.count, callbacks)
    else:
        _by_dask(workers.address, plan, missing, workplace, workers.count, callbacks)


def is_complete(out: str | Path, identity: PlanIdentity) -> bool:
    """Return whether the data set of this plan is complete; if so, remove plan and records left by a killed program."""
    notes = _notes(out)
    if not open_store(out).has(DESCRIPTION):
        return False
    has_plan = notes.has(PLAN)
    if has_plan and differences(_load_plan(notes), identity):
        return False
    remove_notes(notes)
    return has_plan


def require_free_place(out: str | Path) -> None:
    """Raise InputError if `out` exists, so that a command fails before it starts to work."""
    if is_started(out):
        return
    if isinstance(out, str) and is_remote(out):
        if RemoteStore(out).has(DESCRIPTION):
            raise InputError(f"{out} already contains a data set; choose another location, or remove the data set")
    else:
        require_free(local_path(out), "the data set")


def holds_dataset(out: str | Path) -> bool:
    """Return whether there is a complete data set at `out`."""
    return open_store(out).has(DESCRIPTION) and not is_started(out)


def is_started(out: str | Path) -> bool:
    """Return whether a data set at `out` is in progress or was interrupted."""
    return _notes(out).has(PLAN)


def differences(stored: Any, planned: Any) -> list[str]:
    """Return a text for each difference of two plans."""
    return list(_differences(stored, json.loads(json.dumps(planned))))


@contextmanager
def open_workplace(out: str | Path, identity: PlanIdentity, exclusive: bool = True) -> Generator[Workplace]:
    """Open or create the workplace of the data set `out`; `exclusive` locks it against all other programs."""
    if isinstance(out, str) and is_remote(out):
        yield from _open_remote_workplace(out, identity)
        return
    path = local_path(out)
    require_free(path, "the data set")
    # Absolute, because a worker may run in another folder.
    folder = partial_path(path).absolute()
    busy = f"{path} is being made by another program; wait until it has ended, or choose another location"
    has_plan = None if exclusive else (folder / "plan" / PLAN).is_file
    with locked_folder(folder, busy, share_if=has_plan, target=path) as lock:
        notes = LocalStore(folder / "plan")
        plan_id = _plan_id(identity)
        workplace = Workplace(LocalStore(folder / f"dataset-{plan_id}"), notes, str(path), plan_id)
        is_started = notes.has(PLAN)
        if is_started:
            # Files of another plan are kept, so that its own command can resume it.
            _require_same(notes, identity, path, f"remove {folder}")
        try:
            if not is_started:
                _require_still_free(path, folder)
                _create_folders(folder, plan_id)
                notes.put(PLAN, _plan_bytes(identity))
                notes.sync([PLAN])
            if not exclusive:
                lock.share()
            yield workplace
        except BaseException as error:
            # After an InputError the command must change, and another plan cannot use these images.
            if exclusive and folder.is_dir() and not workplace.has_finished(isinstance(error, InputError)):
                shutil.rmtree(folder, ignore_errors=True)
            raise


def stored_identity(out: str | Path) -> PlanIdentity:
    """Return the identity of the plan of a data set in progress."""
    notes = _notes(out)
    if not notes.has(PLAN):
        raise InputError(f"there is no data set in progress at {out}, expected one; start it with generate")
    return _load_plan(notes)


def _notes(out: str | Path) -> Store:
    if isinstance(out, str) and is_remote(out):
        return RemoteStore(f"{out.rstrip('/')}/{NOTES}")
    return LocalStore(partial_path(local_path(out)) / "plan")


def _open_remote_workplace(out: str, identity: PlanIdentity) -> Generator[Workplace]:
    files, notes = RemoteStore(out), RemoteStore(f"{out.rstrip('/')}/{NOTES}")
    workplace = Workplace(files, notes, out, _plan_id(identity))
    if files.has(DESCRIPTION):
        raise InputError(f"{out} already contains a data set; choose another location, or remove the data set")
    is_started = notes.has(PLAN)
    if not is_started:
        if next(files.names(), None) is not None:
            raise InputError(f"{out} already contains other files; choose another location, or remove them")
        notes.put(PLAN, _plan_bytes(identity))
    _require_same(notes, identity, out, f"remove all files below {out}")
    try:
        yield workplace
    except BaseException:
        with contextlib.suppress(Exception):
            if not is_started and not workplace.has_finished():
                files.remove("")
        raise


def _require_still_free(path: Path, folder: Path) -> None:
    # Another program may have completed the data set while this program waited for the lock, which then created
    # `folder` again.
    try:
        require_free(path, "the data set")
    except InputError:
        shutil.rmtree(folder, ignore_errors=True)
        raise


def _create_folders(folder: Path, plan_id: str) -> None:
    # Files without a plan are from a program that was killed before it wrote the plan.
    try:
        clear_folder(folder)
        for inner in ("plan", f"dataset-{plan_id}"):
            (folder / inner).mkdir()
    except OSError as error:
        raise storage_error(folder, error) from error


def _plan_bytes(identity: PlanIdentity) -> bytes:
    return (json.dumps(identity, indent=1) + "\n").encode()


def _plan_id(identity: PlanIdentity) -> str:
    return hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()[:16]


def _load_plan(notes: Store) -> dict[str, Any]:
    try:
        loaded = json.loads(notes.get(PLAN))
    except ValueError as error:
        raise FormatError(f"{notes.location}/{PLAN} is damaged; remove it and its folder, then start again") from error
    return dict(loaded)


def _require_same(notes: Store, identity: PlanIdentity, out: str | Path, remedy: str) -> None:
    differing = differences(_load_plan(notes), identity)
    if differing:
        raise InputError(
            f"{out} was started with another plan ({'; '.join(differing)}); complete it with the first command, "
            f"{remedy}, or choose another location"
        )


def _differences(stored: Any, planned: Any, name: str = "") -> Generator[str]:
    if isinstance(stored, dict) and isinstance(planned, dict):
        stored_values, planned_values = cast("dict[str, Any]", stored), cast("dict[str, Any]", planned)
        for key in dict.fromkeys([*stored_values, *planned_values]):
            # The name in the message is "lights", not "options lights lights".
            inner = name if key in ("options", name.rpartition(" ")[2]) else f"{name} {key}".strip()
            yield from _differences(stored_values.get(key), planned_values.get(key), inner)
    elif stored != planned:
        yield f"{name} {_shortened(stored)}, now {_shortened(planned)}"


def _shortened(value: Any, limit: int = 40) -> str:
    text = json.dumps(value)
    return text if len(text) <= limit else f"{text[:limit]}…"
