"""The simulated LightCrafter: a controller that shows its test pattern, and its HID interface on the simulated bus.

It is found as it is switched on: showing its video input, which is white. It changes its display mode with delay, as
the real one: only after `lag` further questions does it say so.
"""

from __future__ import annotations

import struct
from collections import deque

from drivers.display import lightcrafter as wire
from drivers.display.lightcrafter import PRODUCTS, VENDOR, LightCrafterCommand, LightCrafterReply
from drivers.presenter import WHITE, Colour
from foundation.errors import ProtocolError
from sim.buses.usb import SimulatedUsbDevice, Stalled, UsbIdentity, endpoint_descriptor
from sim.projectors.projector import Screen

REPORT_IN, REPORT_OUT = 0x81, 0x01
"""The endpoints' addresses, those of the real boards."""
VIDEO_INPUT = WHITE


class Controller:
    """A DLPC350 or DLPC900 as far as plain colours go; `lag` is how many reads its mode trails behind."""

    def __init__(self, screen: Screen, lag: int = 2) -> None:
        self._screen = screen
        self._lag = lag
        self._behind = 0
        self._mode = bytes([1])
        self.registers: dict[int, bytes] = {
            LightCrafterCommand.TEST_PATTERN: bytes([8]),
            LightCrafterCommand.PATTERN_COLOUR: struct.pack("<6H", *(wire.FULL,) * 3, 0, 0, 0),
            LightCrafterCommand.INPUT_SOURCE: bytes([0]),
            LightCrafterCommand.DISPLAY_MODE: bytes([1]),
        }
        self._show()

    def write(self, command: int, data: bytes) -> bool:
        """Set a register; False where there is no such register, or it does not take that."""
        if len(data) != len(self.registers.get(command, b"")):
            return False
        if command == LightCrafterCommand.PATTERN_COLOUR:
            try:
                wire.parse_colour(data)
            except ProtocolError:
                return False
        if command == LightCrafterCommand.DISPLAY_MODE and data != self.registers[command]:
            self._behind = self._lag
        self.registers[command] = data
        self._show()
        return True

    def read(self, command: int) -> bytes | None:
        """Return a register, None where there is no such one."""
        if command != LightCrafterCommand.DISPLAY_MODE:
            return self.registers.get(command)
        if self._behind:
            self._behind -= 1
        else:
            self._mode = self.registers[command]
            self._show()
        return self._mode

    def _show(self) -> None:
        registers = self.registers
        generates = (
            self._mode[0] == wire.MODE_VIDEO
            and registers[LightCrafterCommand.INPUT_SOURCE][0] & 7 == wire.SOURCE_TEST_PATTERN
            and registers[LightCrafterCommand.TEST_PATTERN][0] == wire.PATTERN_SOLID
        )
        if generates:
            codes = wire.parse_colour(registers[LightCrafterCommand.PATTERN_COLOUR])
            self._screen.colour = Colour(*(wire.eight_bits(code) for code in codes))
        else:
            self._screen.colour = VIDEO_INPUT


class LightCrafterUsb(SimulatedUsbDevice):
    """A controller's USB side, at full speed."""

    pipes = frozenset({REPORT_IN, REPORT_OUT})

    def __init__(self, controller: Controller, product: int = PRODUCTS["DLPC350"], serial: str = "LCR4500") -> None:
        super().__init__(UsbIdentity(VENDOR, product, serial, "Texas Instruments", "DLPC350", version=0x0110))
        self._controller = controller
        self._replies: deque[bytes] = deque()

    def interface_descriptors(self) -> bytes:
        """Return the descriptors of the HID interface and the two endpoints."""
        interface = struct.pack("<BBBBBBBBB", 9, 4, 0, 0, 2, 3, 0, 0, 0)
        hid = struct.pack("<BBHBBBH", 9, 0x21, 0x0111, 0, 1, 0x22, 36)
        ends = (endpoint_descriptor(address, 3, wire.REPORT, 1) for address in (REPORT_IN, REPORT_OUT))
        return interface + hid + b"".join(ends)

    def write(self, endpoint: int, data: bytes) -> None:
        """Take a report from the host."""
        try:
            request = wire.parse_request(data)
        except ProtocolError as error:
            raise Stalled from error
        if request.reads:
            answer = self._controller.read(request.command)
            reply = LightCrafterReply(request.sequence, answer or b"", refused=answer is None)
        else:
            reply = LightCrafterReply(
                request.sequence, refused=not self._controller.write(request.command, request.data)
            )
        self._replies.append(wire.encode_reply(reply, reads=request.reads))

    def read(self, endpoint: int, limit: int) -> bytes | None:
        """Return the next report to the host, None where there is none."""
        return self._replies.popleft() if self._replies else None

    def unplugged(self) -> None:
        """Forget what was not fetched; the picture stays."""
        self._replies.clear()
