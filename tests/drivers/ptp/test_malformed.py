"""Whatever arrives, every reader returns or raises ProtocolError, and nothing else."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from foundation.errors import ProtocolError
from tests.drivers.ptp.examples import READERS, STREAMS

pytestmark = pytest.mark.slow

Read = Callable[[bytes], object]
ALL = READERS + STREAMS
EVERY = pytest.mark.parametrize(
    ("read", "octets"), [(read, octets) for _, read, octets in ALL], ids=[n for n, *_ in ALL]
)


def outcome(read: Read, data: bytes) -> object:
    """Return what is read, or ProtocolError; let anything else through."""
    try:
        return read(data)
    except ProtocolError:
        return ProtocolError


# A chain of records may end after each of them.
PLAIN = [row for row in READERS if not row[0].startswith("GetEvent")]


@pytest.mark.parametrize(("read", "octets"), [row[1:] for row in PLAIN], ids=[row[0] for row in PLAIN])
def test_cut_short_at_any_byte(read: Read, octets: bytes) -> None:
    assert outcome(read, octets) is not ProtocolError
    for length in range(1, len(octets)):
        assert outcome(read, octets[:length]) is ProtocolError, length


@pytest.mark.parametrize(("read", "octets"), [row[1:] for row in STREAMS], ids=[row[0] for row in STREAMS])
def test_a_stream_cut_short_waits(read: Read, octets: bytes) -> None:
    for length in range(len(octets)):
        assert outcome(read, octets[:length]) is not ProtocolError


@EVERY
def test_any_byte_flipped(read: Read, octets: bytes) -> None:
    for place in range(len(octets)):
        for flip in (0x01, 0x80, 0xFF):
            damaged = bytearray(octets)
            damaged[place] ^= flip
            outcome(read, bytes(damaged))


@EVERY
def test_any_number_inflated(read: Read, octets: bytes) -> None:
    for place in range(len(octets) - 3):
        for number in (0, 0x7FFFFFFF, 0xFFFFFFFF, len(octets) + 1):
            damaged = octets[:place] + number.to_bytes(4, "little") + octets[place + 4 :]
            outcome(read, damaged)


@pytest.mark.parametrize("read", [read for _, read, _ in ALL], ids=[name for name, *_ in ALL])
def test_any_bytes(read: Read) -> None:
    @settings(max_examples=60)
    @given(st.binary(max_size=200))
    @example(b"")
    @example(b"\xff" * 64)
    def check(data: bytes) -> None:
        outcome(read, data)

    check()


@EVERY
def test_pieces_of_others(read: Read, octets: bytes) -> None:
    pieces = [octets, *(row[2] for row in ALL)]
    places = st.integers(0, 100)

    @settings(max_examples=40)
    @given(st.lists(st.tuples(st.sampled_from(pieces), places, places), max_size=4), places)
    def check(cuts: list[tuple[bytes, int, int]], kept: int) -> None:
        outcome(read, octets[:kept] + b"".join(piece[start : start + length] for piece, start, length in cuts))

    check()


@EVERY
def test_no_count_makes_memory(read: Read, octets: bytes) -> None:
    damaged = [octets[:place] + b"\xff\xff\xff\x0f" + octets[place + 4 :] for place in range(len(octets) - 3)]
    tracemalloc.start()
    try:
        for data in damaged:
            outcome(read, data)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 1 << 20
