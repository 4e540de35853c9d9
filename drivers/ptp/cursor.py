"""A place in bytes that a device sent, which never reads past their end.

Rules that hold inside:

- Whatever the bytes are, the only error is `ProtocolError`; it names the dataset, the field, the place, what was
  expected and what came.
- A count is compared with the bytes that are left before anything is made from it, so that memory stays within a
  small multiple of what arrived.
"""

from __future__ import annotations

from foundation.errors import ProtocolError


class Cursor:
    """Reads `data`, little-endian, from its start; `what` names it in messages."""

    def __init__(self, data: bytes, what: str, limit: int | None = None) -> None:
        if limit is not None and len(data) > limit:
            raise ProtocolError(f"{what} of {len(data)} bytes; at most {limit} were expected")
        self._data = bytes(data)
        self.what = what
        self.at = 0
        self._before = 0

    @property
    def left(self) -> int:
        """Bytes not yet read."""
        return len(self._data) - self.at

    def fault(self, field: str, expected: str, came: object, at: int | None = None) -> ProtocolError:
        """Return the error that states what is wrong with the field that was read last, or with the one at `at`."""
        place = self._before if at is None else at
        return ProtocolError(f"{self.what}: {field} at byte {place} is {came}; expected {expected}")

    def take(self, count: int, field: str) -> bytes:
        """Return the next `count` bytes."""
        if count > self.left:
            raise ProtocolError(
                f"{self.what}: {field} at byte {self.at} needs {count} bytes, but only {self.left} follow"
            )
        self._before = self.at
        self.at += count
        return self._data[self._before : self.at]

    def rest(self) -> bytes:
        """Return all bytes that are left."""
        return self.take(self.left, "the rest")

    def integer(self, size: int, field: str, signed: bool = False) -> int:
        """Return the next integer of `size` bytes."""
        return int.from_bytes(self.take(size, field), "little", signed=signed)

    def u8(self, field: str) -> int:
        """Return the next byte."""
        return self.integer(1, field)

    def u16(self, field: str) -> int:
        """Return the next unsigned integer of 2 bytes."""
        return self.integer(2, field)

    def u32(self, field: str) -> int:
        """Return the next unsigned integer of 4 bytes."""
        return self.integer(4, field)

    def u64(self, field: str) -> int:
        """Return the next unsigned integer of 8 bytes."""
        return self.integer(8, field)

    def integers(self, count: int, size: int, field: str, signed: bool = False) -> tuple[int, ...]:
        """Return `count` integers of `size` bytes."""
        if count * size > self.left:
            raise ProtocolError(
                f"{self.what}: {field} at byte {self.at} announces {count} items of {size} bytes, "
                f"but only {self.left} bytes follow"
            )
        octets = self.take(count * size, field)
        return tuple(
            int.from_bytes(octets[at : at + size], "little", signed=signed) for at in range(0, len(octets), size)
        )

    def array(self, size: int, field: str, signed: bool = False) -> tuple[int, ...]:
        """Return an array: a count of 4 bytes, then as many integers of `size` bytes (ISO 15740, 5.3.3)."""
        return self.integers(self.u32(f"the count of {field}"), size, field, signed)
