"""Shards made by threads of this program, or by the workers of a Dask cluster.

An engine takes the shards that are not done and returns when they are, whatever died meanwhile. It knows nothing of
what is in a shard; to make one twice is harmless, see `shards`.
"""

from __future__ import annotations

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
from generator.dataset.production.shards import ShardCancelled, ShardDone, make_elsewhere, make_shard
from generator.dataset.production.workers import SILENT, Callbacks, Workers
from generator.dataset.production.workplace import Workplace

if TYPE_CHECKING:
    import distributed

ATTEMPTS: Final = 5
"""How often a shard is submitted at most. Dask gives a task up once it was on four workers that died; after five times
four it is the shard, and no accident, that kills them."""

CONNECT_S: Final = 10.0
"""How long a scheduler may take to answer, s: one that runs answers in milliseconds, also on a busy network."""

_Event = Callable[[], None]


def make_shards(
    plan: Plan, shards: Sequence[int], place: Workplace, workers: Workers, callbacks: Callbacks = SILENT
) -> None:
    """Make shards of a plan that are not done."""
    if not shards:
        return
    if workers.address is None:
        _by_threads(plan, shards, place, workers.count, callbacks)
    else:
        _by_dask(workers.address, plan, shards, place, workers.count, callbacks)


def _by_threads(plan: Plan, shards: Sequence[int], place: Workplace, workers: int, callbacks: Callbacks) -> None:
    """Make two shards at a time, so that the threads have work while one of the two is being finished."""
    events: SimpleQueue[_Event | None] = SimpleQueue()
    cancelled = threading.Event()
    waiting = iter(shards)
    taking = threading.Lock()
    at_once = min(2, len(shards), workers)
    depth = -(-workers // at_once)
    queued = Callbacks(
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
            for _ in range(done.images):
                callbacks.on_image()
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
