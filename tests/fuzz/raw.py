"""Raw files with bytes, types, counts, pointers and lengths changed, by seed: run by hand, never by pytest.

    python -m tests.fuzz.raw --cases 100000 --seed 1 [--from N] [--more FOLDER] [--keep FOLDER]

Begun from are the tiny files of `tests.drivers.raw.maker_files`, DNG as tifffile and imagecodecs write them, and what
lies in `--more`. Each case goes through `decode_raw` in a process of its own, since LibRaw, which sees what our checks
accept, may crash. Wrong is: an error other than `FormatError`, more than 1 s of processor or 3 GB, a crash, and a frame
that is accepted though rows of it hold nothing but one number, though it has more photosites than bytes could say, or
though parts of it were never written (of every eighth case, read again into memory that holds one number).
What was found is in tests/data/raw/found.zip, which `tests/drivers/raw/test_rawfile.py` reads.
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
SLOWEST_S = 1.0
LARGEST_BYTES = 3 << 30
PATIENCE_S = 300.0


@dataclass(frozen=True)
class Finding:
    """What went wrong with a case, in words, and the case's number."""

    number: int
    what: str


def seeds(more: Path | None) -> dict[str, bytes]:
    """Return the files that are changed, by name."""
    files = {name: data for name, (data, _) in maker_files().items()}
    tones, full = counts_of(12), counts_of(14)
    strip = bytes(imagecodecs.ljpeg_encode(full, bitspersample=14))
    files["dng of imagecodecs"] = dng_bytes(full, {259: shorts(7), 258: shorts(14)}, strip)
    files["dng of tifffile"] = _by_tifffile(tones, tile=None, big=False)
    files["dng of tifffile, tiles"] = _by_tifffile(tones, tile=(16, 32), big=False)
    files["dng of tifffile, big-endian"] = _by_tifffile(tones, tile=None, big=True)
    active = longs(2, 4, ROWS, COLUMNS)
    files["dng, active area"] = dng_bytes(tones, {50829: active, 50830: longs(0, 0, ROWS, 4)})
    pixels = np.random.default_rng(1).bytes(4000)
    places = box(b"stsz", struct.pack(">III", 0, 4000, 1)), box(b"co64", struct.pack(">IIQ", 0, 1, 700))
    files["cr3"] = cr3("Canon EOS R", track(areas(), b"CRAW", (COLUMNS, ROWS), *places), pixels=pixels)
    for path in sorted(more.iterdir()) if more is not None else ():
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
    """Return the places of all entries of a TIFF's first directories, with the order of bytes; none of other files."""
    order = {b"II": "<", b"MM": ">"}.get(data[:2])
    if order is None:
        return []
    found: list[tuple[str, int]] = []
    waiting, seen = [int(struct.unpack_from(order + "I", data, 4)[0])], set[int]()
    while waiting and len(seen) < 8:
        at = waiting.pop()
        if at in seen or not 8 <= at < len(data) - 2:
            continue
        seen.add(at)
        (count,) = struct.unpack_from(order + "H", data, at)
        for number in range(min(count, 64)):
            place = at + 2 + 12 * number
            if place + 12 > len(data):
                break
            found.append((order, place))
            tag, _, _, value = struct.unpack_from(order + "HHII", data, place)
            if tag in (330, 34665):
                waiting.append(value)
    return found


def changed(rng: random.Random, seed: bytes, where: list[tuple[str, int]]) -> bytes:
    """Return a file after a few changes."""
    data = bytearray(seed)
    for _ in range(rng.choice((1, 1, 1, 2, 2, 3, 5))):
        if where and rng.random() < 0.55:
            _change_entry(rng, data, *rng.choice(where))
        elif data:
            _change_bytes(rng, data)
    return bytes(data)


def _change_entry(rng: random.Random, data: bytearray, order: str, place: int) -> None:
    if place > len(data) - 38:
        return
    what = rng.randrange(6)
    (old,) = struct.unpack_from(order + "I", data, place + 8)
    near = (old + rng.choice((-4096, -16, -2, -1, 1, 2, 16, 4096))) & 0xFFFFFFFF
    if what == 0:
        (other,) = struct.unpack_from(order + "H", data, max(place + 12 * rng.randrange(-2, 3), 0))
        struct.pack_into(order + "H", data, place, rng.choice((rng.randrange(1 << 16), other)))
    elif what == 1:
        struct.pack_into(order + "H", data, place + 2, rng.randrange(20))
    elif what == 2:
        struct.pack_into(order + "I", data, place + 4, rng.choice(NASTY))
    elif what == 3:
        struct.pack_into(order + "I", data, place + 8, rng.choice(NASTY))
    elif what == 4:
        struct.pack_into(order + "I", data, place + 8, near)
    else:
        struct.pack_into(order + "H", data, place + 8, rng.choice(NASTY) & 0xFFFF)


def _change_bytes(rng: random.Random, data: bytearray) -> None:
    # Mostly where a byte decides how the others are read.
    at = rng.randrange(min(len(data), 900) if rng.random() < 0.6 else len(data))
    length = rng.choice((1, 2, 4, 16, 64, 512, 4096))
    what = rng.randrange(9)
    if what == 0:
        data[at] ^= 1 << rng.randrange(8)
    elif what == 1:
        data[at] = rng.randrange(256)
    elif what in (2, 3):
        word = struct.pack(rng.choice("<>") + "I", rng.choice(NASTY))[: rng.choice((2, 4))]
        data[at : at + len(word)] = word[: len(data) - at]
    elif what == 4:
        del data[at:]
    elif what == 5:
        data[at : at + length] = bytes(min(length, len(data) - at))
    elif what == 6:
        data[at : at + length] = b"\xff" * min(length, len(data) - at)
    elif what == 7:
        del data[at : at + length]
    else:
        start = rng.randrange(len(data))
        data[at:at] = data[start : start + length]


def case(files: dict[str, bytes], seed: int, number: int) -> tuple[str, bytes]:
    """Return which file was changed, and what became of it."""
    rng = random.Random(f"{seed}/{number}")
    name = rng.choice(sorted(files))
    return name, changed(rng, files[name], entries(files[name]))


def fault_of(data: bytes, mosaic: Mosaic) -> str | None:
    """Return why a frame should not have been accepted; None if it may be one."""
    if filled_fault(mosaic.counts, mosaic.black, mosaic.white_level) is not None:
        return None  # import, judge and build refuse it
    sensor, counts = mosaic.sensor, mosaic.counts
    if 8 * len(data) < sensor.size:
        return f"{sensor.shape} of {len(data)} bytes"
    # The counts of the files begun from are noise: no row of them is flat.
    flat = np.flatnonzero(counts.max(axis=1) == counts.min(axis=1))
    # Too much light and ones written over plain pixels look alike, and one row more is cut by what was done.
    if len(flat) < 3 or bytes((255,)) * 100 in data:
        return None
    return f"{len(flat)} of {counts.shape[0]} rows are flat, of {counts[flat[0], 0]}"


_POISON = 0x5A5A


@cache
def _poison(rows: int, columns: int) -> bytes:
    return dng_bytes(np.full((rows, columns), _POISON, np.uint16), {50717: longs(65535)})


def unwritten(data: bytes, shape: tuple[int, ...]) -> str | None:
    """Return how much of a frame LibRaw leaves as its memory was before, which is filled with one number for that."""
    decode_raw(_poison(*shape), Path("poison"))
    left = float((decode_raw(data, Path("case")).sensor == _POISON).mean())
    return f"{left:.1%} of {shape} was not written" if left > 0.01 else None


def _work(files: dict[str, bytes], seed: int, first: int, end: int, at: Synchronized[int], pipe: Connection) -> None:
    """Try cases, with `at` the number of the one that is tried, and send what became of them now and then."""
    resource.setrlimit(resource.RLIMIT_AS, (LARGEST_BYTES, LARGEST_BYTES))
    for data in files.values():  # what is compiled or loaded once belongs to no case
        with suppress(FormatError):
            decode_raw(data, Path("seed"))
    tally = Counter[str]()
    for number in range(first, end):
        at.value = number
        name, data = case(files, seed, number)
        begun, wrong = time.process_time(), None
        try:
            mosaic = decode_raw(data, Path("case"))
            outcome, wrong, shape = "accepted", fault_of(data, mosaic), mosaic.sensor.shape
            del mosaic
            if wrong is None and number % 8 == 0:
                wrong = unwritten(data, shape)
        except FormatError as error:
            outcome = "refused"
            if isinstance(error.__cause__, MemoryError) or "alloc" in str(error):
                wrong = "too much memory"
        except Exception:
            outcome, wrong = "error", traceback.format_exc(limit=-4)
        taken = time.process_time() - begun
        if wrong is None and taken > SLOWEST_S:
            wrong = f"took {taken:.1f} s"
        tally[f"{name}: {outcome}"] += 1
        if wrong is not None or number % 1000 == 999 or number == end - 1:
            pipe.send((tally, None if wrong is None else Finding(number, wrong)))
            tally.clear()
    pipe.send(None)


def run(files: dict[str, bytes], seed: int, cases: range, tally: Counter[str]) -> Iterator[Finding]:
    """Yield what goes wrong; a process that crashes or hangs is a finding, too, and another goes on behind it."""
    context = multiprocessing.get_context("spawn")
    first = cases.start
    while first < cases.stop:
        ours, theirs = context.Pipe(duplex=False)
        at = context.Value("q", first)
        worker = context.Process(target=_work, args=(files, seed, first, cases.stop, at, theirs), daemon=True)
        worker.start()
        theirs.close()
        seen = -1
        try:
            while ours.poll(PATIENCE_S) or at.value != seen:
                seen = at.value
                if not ours.poll():
                    continue
                said = ours.recv()
                if said is None:
                    return
                tally.update(said[0])
                if said[1] is not None:
                    yield said[1]
            yield Finding(at.value, "hangs")
        except EOFError:
            worker.join()
            yield Finding(at.value, f"crashed, exit code {worker.exitcode}")
        finally:
            worker.kill()
            worker.join()
        first = at.value + 1


def main() -> int:
    """Try cases; print what became of them and what went wrong, and return how many did, 99 at most."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--from", dest="first", type=int, default=0, help="number of the first case")
    parser.add_argument("--more", type=Path, help="folder of further files to begin from")
    parser.add_argument("--keep", type=Path, help="folder to which the files that went wrong are written")
    chosen = parser.parse_args()
    files, tally, wrong = seeds(chosen.more), Counter[str](), 0
    for finding in run(files, chosen.seed, range(chosen.first, chosen.first + chosen.cases), tally):
        wrong += 1
        name, data = case(files, chosen.seed, finding.number)
        print(f"--seed {chosen.seed}, case {finding.number}, of {name}: {finding.what}", flush=True)
        if chosen.keep is not None:
            chosen.keep.mkdir(parents=True, exist_ok=True)
            (chosen.keep / f"{chosen.seed}-{finding.number}.raw").write_bytes(data)
    for outcome, times in sorted(tally.items()):
        print(f"{times:8d}  {outcome}")
    used = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    seconds = sum(one.ru_utime + one.ru_stime for one in used)
    print(f"{chosen.cases} cases in {seconds:.0f} s of processor time, {wrong} went wrong")
    return min(wrong, 99)


if __name__ == "__main__":
    raise SystemExit(main())
