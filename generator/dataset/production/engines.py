"""Who makes the shards: threads of this program, or the workers of a Dask cluster.

An engine is handed shards that are not done and returns when they are, whatever died meanwhile. It knows nothing of
what is in a shard; making one twice is harmless, see `shards`.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from itertools import islice
from queue import SimpleQueue
from typing import TYPE_CHECKING, Final

from foundation.errors import CropError, DeviceError, InputError
from generator.dataset.production.plan import Plan
from generator.dataset.production.shards import Done, OnImage, OnSkip, Stopped, make_elsewhere, make_shard
from generator.dataset.production.workplace import Workplace

if TYPE_CHECKING:
    import distributed

ATTEMPTS: Final = 5
"""How often a shard is handed out again after it was on several workers when they died."""

CONNECT_S: Final = 10.0
"""How long a scheduler may take to answer, s."""

OnWait = Callable[[str], None]
"""Takes a sentence for the user on what the work waits for."""

_Event = Callable[[], None]


def parse_engine(text: str) -> str | None:
    """Return the address of the Dask scheduler that an engine's name asks for.

    Returns
    -------
    str or None
        `tcp://HOST:PORT`; empty for a cluster on this machine; None for threads of this program.

    Raises
    ------
    InputError
        It is none of `local`, `dask`, `dask://HOST:PORT`.
    """
    if text == "local":
        return None
    if text == "dask":
        return ""
    match = re.fullmatch(r"dask://([^/\s]+:\d+)/?", text)
    if not match:
        raise InputError(f"{text!r} is no engine; use local, dask, or dask://HOST:PORT of a Dask scheduler")
    return f"tcp://{match[1]}"


def check_workers(engine: str, workers: int) -> str | None:
    """Return what `parse_engine` returns, after looking at the number of workers too.

    Raises
    ------
    InputError
        There is no such engine, or no worker.
    """
    if workers < 1:
        raise InputError(f"{workers} workers were asked for, expected 1 or more")
    return parse_engine(engine)


def make_shards(
    engine: str,
    plan: Plan,
    shards: Sequence[int],
    place: Workplace,
    workers: int,
    on_image: OnImage,
    on_skip: OnSkip,
    on_wait: OnWait,
) -> None:
    """Make shards that are not done, on an engine.

    Parameters
    ----------
    engine
        See `parse_engine`.
    plan, shards
        What to make of what.
    place
        Where.
    workers
        Threads, or processes of a cluster on this machine; a cluster that is named has its own.
    on_image, on_skip
        Called after each image, and for each source that cannot be read, from the calling thread.
    on_wait
        Called with a sentence for the user when a scheduler that was named has no worker.

    Raises
    ------
    InputError
        There is no such engine, it cannot be reached, or its workers have another table or other libraries.
    DeviceError
        A shard has killed its workers time and again, or the cluster was lost.
    StorageError
        The disk is full, read-only or gone.
    """
    address = check_workers(engine, workers)
    if not shards:
        return
    if address is None:
        _by_threads(plan, shards, place, workers, on_image, on_skip)
    else:
        _by_dask(address, plan, shards, place, workers, on_image, on_skip, on_wait)


def _by_threads(
    plan: Plan, shards: Sequence[int], place: Workplace, workers: int, on_image: OnImage, on_skip: OnSkip
) -> None:
    """Make two shards at a time, so that the threads have work while one of the two is being finished."""
    events: SimpleQueue[_Event | None] = SimpleQueue()
    stop = threading.Event()
    waiting = iter(shards)
    taking = threading.Lock()
    at_once = min(2, len(shards), workers)
    depth = -(-workers // at_once)

    def drive(pool: ThreadPoolExecutor) -> None:
        def skip(name: str, reason: str, images: int) -> None:
            events.put(lambda: on_skip(name, reason, images))

        def fail(error: BaseException) -> None:
            raise error

        try:
            while not stop.is_set():
                with taking:
                    shard = next(waiting, None)
                    if shard is None:
                        return
                    job = plan.job(shard)
                make_shard(job, plan.lut, place, pool, depth, lambda: events.put(on_image), skip, stop)
        except Stopped:
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
            stop.set()


def _by_dask(
    address: str,
    plan: Plan,
    shards: Sequence[int],
    place: Workplace,
    workers: int,
    on_image: OnImage,
    on_skip: OnSkip,
    on_wait: OnWait,
) -> None:
    try:
        from distributed import KilledWorker, as_completed
    except ImportError as error:
        raise InputError("the engine dask needs Dask; install it with: pip install croplab[cluster]") from error

    attempts = dict.fromkeys(shards, 0)
    waiting: Iterator[int] = iter(shards)
    with _client(address, workers) as client:

        def submit(shard: int) -> distributed.Future[Done]:
            attempts[shard] += 1
            key = f"crop-shard-{shard}-{attempts[shard]}-{plan.seed}-{id(plan)}"
            return client.submit(make_elsewhere, plan.job(shard), place, key=key, pure=False)

        threads = client.nthreads()
        if not threads:
            on_wait(f"the Dask scheduler has no worker yet; start some with: dask worker {address}")
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
            for told in done.skipped:
                on_skip(*told)
            for _ in range(done.images):
                on_image()
            following = next(waiting, None)
            if following is not None:
                future = submit(following)
                running[future] = following
                futures.add(future)


@contextmanager
def _client(address: str, workers: int) -> Generator[distributed.Client]:
    """Connect to a scheduler, or to a cluster of processes of this machine that ends with the block."""
    import logging

    from distributed import Client, LocalCluster

    if address:
        try:
            client = Client(address, timeout=CONNECT_S, set_as_default=False)
        except (OSError, TimeoutError) as error:
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
