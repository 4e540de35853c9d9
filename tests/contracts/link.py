"""Contract tests of every cable; a suite supplies its cable with the fixture `ends`."""

from __future__ import annotations

import pytest

from drivers.links.link import Link
from foundation.errors import LinkClosed, LinkTimeout

# The near end, which is tested, and the far end, which helps.
Ends = tuple[Link, Link]

# Time limit for expected data; reached only by a failing test.
PATIENCE_S = 10.0


def read_exactly(link: Link, size: int) -> bytes:
    """Return `size` bytes, read in pieces of any size."""
    data = b""
    while len(data) < size:
        data += link.read(size - len(data), PATIENCE_S)
    return data


class LinkContract:
    """Subclass it as ``TestX`` and supply the fixture `ends`."""

    def test_transfers_bytes_in_both_directions(self, ends: Ends) -> None:
        near, far = ends
        near.write(b"\x00question\r\n", PATIENCE_S)
        assert read_exactly(far, 11) == b"\x00question\r\n"
        far.write(b"answer\xff", PATIENCE_S)
        assert read_exactly(near, 7) == b"answer\xff"

    def test_keeps_order_and_all_bytes(self, ends: Ends) -> None:
        near, far = ends
        pieces = [bytes([number]) * (number + 1) for number in range(100)]
        for piece in pieces:
            far.write(piece, PATIENCE_S)
        assert read_exactly(near, 5050) == b"".join(pieces)

    def test_read_respects_its_limit(self, ends: Ends) -> None:
        near, far = ends
        far.write(b"abcdef", PATIENCE_S)
        first = near.read(2, PATIENCE_S)
        assert 1 <= len(first) <= 2
        assert first + read_exactly(near, 6 - len(first)) == b"abcdef"

    def test_silence_is_timeout_and_link_stays_usable(self, ends: Ends) -> None:
        near, far = ends
        assert near.read(10, 0.0) == b""
        with pytest.raises(LinkTimeout):
            near.read(10, 0.001)
        far.write(b"late", PATIENCE_S)
        assert read_exactly(near, 4) == b"late"

    def test_reads_data_sent_before_close(self, ends: Ends) -> None:
        near, far = ends
        far.write(b"last words", PATIENCE_S)
        far.close()
        assert read_exactly(near, 10) == b"last words"
        with pytest.raises(LinkClosed):
            near.read(1, PATIENCE_S)

    def test_notices_closed_far_end_at_next_exchange(self, ends: Ends) -> None:
        near, far = ends
        far.close()
        # A cable may accept bytes before it notices that the far end is closed.
        with pytest.raises(LinkClosed):
            _exchange(near)

    def test_closed_end_refuses_data(self, ends: Ends) -> None:
        near, _ = ends
        near.close()
        near.close()
        with pytest.raises(LinkClosed):
            near.write(b"x", PATIENCE_S)
        with pytest.raises(LinkClosed):
            near.read(1, PATIENCE_S)


def _exchange(link: Link) -> None:
    link.write(b"anybody there?", PATIENCE_S)
    link.read(1, PATIENCE_S)
