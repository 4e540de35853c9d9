"""Fuzz raw files: changed bytes, types, counts, pointers and lengths, by seed; run it by hand, not with pytest.

    python -m tests.fuzz.raw --cases 100000 --seed 1 [--from N] [--more FOLDER] [--keep FOLDER]

The initial files are the tiny ones of `tests.drivers.raw.maker_files`, DNG files of tifffile and imagecodecs, and the
files in `--more`. Each case is decoded by `decode_raw` in a separate process, because LibRaw may crash on files that
our checks accept. Faults are: an error other than `FormatError`, more than 1 s of processor time or 3 GB, a crash, and
a frame that is accepted although rows are flat, or it has more photosites than the file can hold, or parts were never
written (checked for every eighth case by decoding into memory filled with one number). Earlier faults are in
tests/data/raw/found.zip, which `tests/drivers/raw/test_rawfile.py` reads.
"""

from __future__ import annotations

import argparse
import io
import multiprocessing
import random
import resource
import struct
import time
import traceback
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from multiprocessing.connection import Connection
from multiprocessing.sharedctypes import Synchronized
from pathlib import Path

import imagecodecs
import numpy as np
import tifffile

from drivers.raw.rawfile import Mosaic, decode_raw, filled_fault
from foundation.errors import FormatError
from tests.drivers.raw.maker_files import COLUMNS, ROWS, Counts, areas, box, counts_of, cr3, maker_files, track
from tests.drivers.raw.raw_files import dng_bytes, longs, shorts

NASTY = (
    0, 1, 2, 3, 4, 7, 8, 12, 14, 15, 16, 17, 31, 32, 33, 47, 48, 49, 64, 79, 80, 81, 96, 127, 128, 255, 256, 512, 1023,
    4095, 4096, 16383, 16384, 32767, 32768, 32803, 34713, 34892, 52546, 65535, 65536, 1 << 20, 1 << 24, 0x7FFFFFFF,
    0x80000000, 0xFFFFFFF0, 0xFFFFFFFE, 0xFFFFFFFF,
)  # fmt: skip
MAX_S = 1.0
MAX_BYTES = 3 << 30
PATIENCE_S = 300.0


@dataclass(frozen=True)
class Finding:
    """Number and fault of a case."""

    number: int
    fault: str


def seeds(more_folder: Path | None) -> dict[str, bytes]:
    """Return the initial files by name."""
    files = {name: data for name, (data, _) in maker_files().items()}
    counts, full_counts = counts_of(12), counts_of(14)
    strip = bytes(imagecodecs.ljpeg_encode(full_counts, bitspersample=14))
    files["dng of imagecodecs"] = dng_bytes(full_counts, {259: shorts(7), 258: shorts(14)}, strip)
    files["dng of tifffile"] = _by_tifffile(counts, tile=None, big=False)
    files["dng of tifffile, tiles"] = _by_tifffile(counts, tile=(16, 32), big=False)
    files["dng of tifffile, big-endian"] = _by_tifffile(counts, tile=None, big=True)
    active = longs(2, 4, ROWS, COLUMNS)
    files["dng, active area"] = dng_bytes(counts, {50829: active, 50830: longs(0, 0, ROWS, 4)})
    pixels = np.random.default_rng(1).bytes(4000)
    boxes = box(b"stsz", struct.pack(">III", 0, 4000, 1)), box(b"co64", struct.pack(">IIQ", 0, 1, 700))
    files["cr3"] = cr3("Canon EOS R", track(areas(), b"CRAW", (COLUMNS, ROWS), *boxes), pixels=pixels)
    for path in sorted(more_folder.iterdir()) if more_folder is not None else ():
        files[path.name] = path.read_bytes()
    return files


def _by_tifffile(counts: Counts, tile: tuple[int, int] | None, big: bool) -> bytes:
    stream = io.BytesIO()
    extra = [
        (33421, 3, 2, (2, 2), True),
        (33422, 1, 4, (0, 1, 1, 2), True),
        (50706, 1, 4, (1, 4, 0, 0), True),
        (50714, 3, 1, 64, True),
        (50717, 3, 1, 4095, True),
    ]
    with tifffile.TiffWriter(stream, byteorder=">" if big else "<") as writer:
        writer.write(counts, photometric=32803, tile=tile, rowsperstrip=16, extratags=extra, metadata=None)
    return stream.getvalue()


@cache
def entries(data: bytes) -> list[tuple[str, int]]:
    """Return byte order and offset of all entries in the first directories of a TIFF file; empty for others."""
    order = {b"II": "<", b"MM": ">"}.get(data[:2])
    if order is None:
        return []
    offsets: list[tuple[str, int]] = []
    queue, visited = [int(struct.unpack_from(order + "I", data, 4)[0])], set[int]()
    while queue and len(visited) < 8:
        directory = queue.pop()
        if directory in visited or not 8 <= directory < len(data) - 2:
            continue
        visited.add(directory)
        (count,) = struct.unpack_from(order + "H", data, directory)
        for number in range(min(count, 64)):
            offset = directory + 2 + 12 * number
            if offset + 12 > len(data):
                break
            offsets.append((order, offset))
            tag, _, _, value = struct.unpack_from(order + "HHII", data, offset)
            if tag in (330, 34665):
                queue.append(value)
    return offsets


def changed(rng: random.Random, seed: bytes, entry_offsets: list[tuple[str, int]]) -> bytes:
    """Return a file after a few changes."""
    data = bytearray(seed)
    for _ in range(rng.choice((1, 1, 1, 2, 2, 3, 5))):
        if entry_offsets and rng.random() < 0.55:
            _change_entry(rng, data, *rng.choice(entry_offsets))
        elif data:
            _change_bytes(rng, data)
    return bytes(data)


def _change_entry(rng: random.Random, data: bytearray, order: str, offset: int) -> None:
    if offset > len(data) - 38:
        return
    change = rng.randrange(6)
    (old,) = struct.unpack_from(order + "I", data, offset + 8)
    shifted = (old + rng.choice((-4096, -16, -2, -1, 1, 2, 16, 4096))) & 0xFFFFFFFF
    if change == 0:
        (neighbour,) = struct.unpack_from(order + "H", data, max(offset + 12 * rng.randrange(-2, 3), 0))
        struct.pack_into(order + "H", data, offset, rng.choice((rng.randrange(1 << 16), neighbour)))
    elif change == 1:
        struct.pack_into(order + "H", data, offset + 2, rng.randrange(20))
    elif change == 2:
        struct.pack_into(order + "I", data, offset + 4, rng.choice(NASTY))
    elif change == 3:
        struct.pack_into(order + "I", data, offset + 8, rng.choice(NASTY))
    elif change == 4:
        struct.pack_into(order + "I", data, offset + 8, shifted)
    else:
        struct.pack_into(order + "H", data, offset + 8, rng.choice(NASTY) & 0xFFFF)


def _change_bytes(rng: random.Random, data: bytearray) -> None:
    # Mostly in the header, where bytes determine how others are read.
    offset = rng.randrange(min(len(data), 900) if rng.random() < 0.6 else len(data))
    length = rng.choice((1, 2, 4, 16, 64, 512, 4096))
    change = rng.randrange(9)
    if change == 0:
        data[offset] ^= 1 << rng.randrange(8)
    elif change == 1:
        data[offset] = rng.randrange(256)
    elif change in (2, 3):
        word = struct.pack(rng.choice("<>") + "I", rng.choice(NASTY))[: rng.choice((2, 4))]
        data[offset : offset + len(word)] = word[: len(data) - offset]
    elif change == 4:
        del data[offset:]
    elif change == 5:
        data[offset : offset + length] = bytes(min(length, len(data) - offset))
    elif change == 6:
        data[offset : offset + length] = b"\xff" * min(length, len(data) - offset)
    elif change == 7:
        del data[offset : offset + length]
    else:
        start = rng.randrange(len(data))
        data[offset:offset] = data[start : start + length]


def case(files: dict[str, bytes], seed: int, number: int) -> tuple[str, bytes]:
    """Return the name of the initial file and the changed file."""
    rng = random.Random(f"{seed}/{number}")
    name = rng.choice(sorted(files))
    return name, changed(rng, files[name], entries(files[name]))


def fault_of(data: bytes, mosaic: Mosaic) -> str | None:
    """Return why a frame should not have been accepted, or None."""
    if filled_fault(mosaic.counts, mosaic.black, mosaic.white_level) is not None:
        return None  # import, judge and build refuse it
    sensor, counts = mosaic.sensor, mosaic.counts
    if 8 * len(data) < sensor.size:
        return f"{sensor.shape} of {len(data)} bytes"
    # The initial files contain noise, so none of their rows is flat.
    flat = np.flatnonzero(counts.max(axis=1) == counts.min(axis=1))
    # Saturation and overwritten pixels look alike, and a change may cut one more row.
    if len(flat) < 3 or bytes((255,)) * 100 in data:
        return None
    return f"{len(flat)} of {counts.shape[0]} rows are flat, with the value {counts[flat[0], 0]}"


_POISON = 0x5A5A


@cache
def _poison(rows: int, columns: int) -> bytes:
    return dng_bytes(np.full((rows, columns), _POISON, np.uint16), {50717: longs(65535)})


def unwritten(data: bytes, shape: tuple[int, ...]) -> str | None:
    """Return how much of a frame LibRaw leaves unwritten in memory filled with one number, or None."""
    decode_raw(_poison(*shape), Path("poison"))
    unwritten_share = float((decode_raw(data, Path("case")).sensor == _POISON).mean())
    return f"{unwritten_share:.1%} of {shape} was not written" if unwritten_share > 0.01 else None


def _work(
    files: dict[str, bytes], seed: int, first: int, end: int, current: Synchronized[int], pipe: Connection
) -> None:
    """Try cases; `at` holds the number of the present case; send results from time to time."""
    resource.setrlimit(resource.RLIMIT_AS, (MAX_BYTES, MAX_BYTES))
    for data in files.values():  # so that compiling and loading count for no case
        with suppress(FormatError):
            decode_raw(data, Path("seed"))
    tally = Counter[str]()
    for number in range(first, end):
        current.value = number
        name, data = case(files, seed, number)
        start, fault = time.process_time(), None
        try:
            mosaic = decode_raw(data, Path("case"))
            outcome, fault, shape = "accepted", fault_of(data, mosaic), mosaic.sensor.shape
            del mosaic
            if fault is None and number % 8 == 0:
                fault = unwritten(data, shape)
        except FormatError as error:
            outcome = "refused"
            if isinstance(error.__cause__, MemoryError) or "alloc" in str(error):
                fault = "too much memory"
        except Exception:
            outcome, fault = "error", traceback.format_exc(limit=-4)
        seconds = time.process_time() - start
        if fault is None and seconds > MAX_S:
            fault = f"took {seconds:.1f} s"
        tally[f"{name}: {outcome}"] += 1
        if fault is not None or number % 1000 == 999 or number == end - 1:
            pipe.send((tally, None if fault is None else Finding(number, fault)))
            tally.clear()
    pipe.send(None)


def run(files: dict[str, bytes], seed: int, cases: range, tally: Counter[str]) -> Iterator[Finding]:
    """Yield the faults; after a crash or hang, which is a fault too, another process continues."""
    context = multiprocessing.get_context("spawn")
    first = cases.start
    while first < cases.stop:
        ours, theirs = context.Pipe(duplex=False)
        current = context.Value("q", first)
        worker = context.Process(target=_work, args=(files, seed, first, cases.stop, current, theirs), daemon=True)
        worker.start()
        theirs.close()
        last_number = -1
        try:
            while ours.poll(PATIENCE_S) or current.value != last_number:
                last_number = current.value
                if not ours.poll():
                    continue
                report = ours.recv()
                if report is None:
                    return
                tally.update(report[0])
                if report[1] is not None:
                    yield report[1]
            yield Finding(current.value, "hangs")
        except EOFError:
            worker.join()
            yield Finding(current.value, f"crashed, exit code {worker.exitcode}")
        finally:
            worker.kill()
            worker.join()
        first = current.value + 1


def main() -> int:
    """Try cases and print results and faults; return the number of faults, at most 99."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--from", dest="first", type=int, default=0, help="number of the first case")
    parser.add_argument("--more", type=Path, help="folder of additional initial files")
    parser.add_argument("--keep", type=Path, help="folder for the files that caused faults")
    options = parser.parse_args()
    files, tally, fault_count = seeds(options.more), Counter[str](), 0
    for finding in run(files, options.seed, range(options.first, options.first + options.cases), tally):
        fault_count += 1
        name, data = case(files, options.seed, finding.number)
        print(f"--seed {options.seed}, case {finding.number}, of {name}: {finding.fault}", flush=True)
        if options.keep is not None:
            options.keep.mkdir(parents=True, exist_ok=True)
            (options.keep / f"{options.seed}-{finding.number}.raw").write_bytes(data)
    for outcome, times in sorted(tally.items()):
        print(f"{times:8d}  {outcome}")
    used = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    seconds = sum(usage.ru_utime + usage.ru_stime for usage in used)
    print(f"{options.cases} cases in {seconds:.0f} s of processor time, {fault_count} faults")
    return min(fault_count, 99)


if __name__ == "__main__":
    raise SystemExit(main())
