"""A long series over the EOS driver with frequent faults of body and cable."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from drivers.camera import CapturedFrame, capture
from drivers.canon import CanonEos, OtherRecord, TransferRequest, decode_events, encode_events
from drivers.links.usb import UsbPipes
from drivers.ptp.codes import Operation, ResponseCode
from drivers.ptp.protocol import Answer, NoAnswer, PtpRequest, PtpResponse, Responder
from foundation.errors import DeviceError, DeviceRefused
from foundation.files import atomic_file
from sim.camera.bodies import EOS_550D
from tests.cable_faults import CutOff, TroubledResponder
from tests.contracts.camera import SETTINGS
from tests.drivers.eos_lab import Lab

pytestmark = pytest.mark.slow

FRAMES = 150
# Attempts per frame; the default of the sequencer is three, for a better laboratory.
ATTEMPTS = 6
# Share of operations with a fault.
TROUBLE = 0.05
KILLED_EVERY = 40


class FaultyBody(TroubledResponder):
    """A body with random faults."""

    def __init__(self, good: Responder, seed: int, unplug: Callable[[], object]) -> None:
        super().__init__(good)
        self._chance = random.Random(seed)
        self._unplug = unplug
        self.fault_counts: Counter[str] = Counter()

    def answer(self, request: PtpRequest, data: bytes | None) -> Answer:
        if self._chance.random() >= TROUBLE:
            return super().answer(request, data)
        fault = self._chance.choice(
            (self._busy, self._general_error, self._no_answer, self._lost_answer, self._unplugged, self._wrong_data)
        )
        self.fault_counts[fault.__name__] += 1
        return fault(request, data)

    def _busy(self, request: PtpRequest, data: bytes | None) -> Answer:
        return Answer(PtpResponse(ResponseCode.DEVICE_BUSY, request.transaction))

    def _general_error(self, request: PtpRequest, data: bytes | None) -> Answer:
        return Answer(PtpResponse(ResponseCode.GENERAL_ERROR, request.transaction))

    def _no_answer(self, request: PtpRequest, data: bytes | None) -> Answer:
        raise NoAnswer

    def _lost_answer(self, request: PtpRequest, data: bytes | None) -> Answer:
        super().answer(request, data)
        raise NoAnswer

    def _unplugged(self, request: PtpRequest, data: bytes | None) -> Answer:
        self._unplug()
        raise NoAnswer

    def _wrong_data(self, request: PtpRequest, data: bytes | None) -> Answer:
        """Send too few or too many data; lose, double and invent events."""
        answer = super().answer(request, data)
        if answer.data is None:
            return answer
        if request.code != Operation.EOS_GET_EVENT:
            changed = self._chance.choice((answer.data[:-1], answer.data + b"more", b""))
            return Answer(answer.response, changed)
        records = decode_events(answer.data)
        transfers = [record for record in records if isinstance(record, TransferRequest)]
        other_records = [record for record in records if record not in transfers]
        changed = self._chance.choice((other_records, [*records, *transfers], [*records, OtherRecord(0xC1FE, b"?")]))
        return Answer(answer.response, encode_events(changed))


@pytest.mark.parametrize("forgetful", [False, True], ids=["keeps frames", "forgets frames"])
def test_completes_series_with_faulty_body_and_cable(tmp_path: Path, forgetful: bool) -> None:
    lab = Lab(replace(EOS_550D, shots_per_charge=10_000), film_bytes=300, forgetful=forgetful)  # on mains power
    chance = random.Random(707)
    cables: list[_Cable] = []
    body = FaultyBody(lab.eos, 1, lambda: cables[-1].pull())
    lab.device = body

    def cable(pipes: UsbPipes) -> UsbPipes:
        cables.append(_Cable(pipes, lab, chance.randrange(40_000, 400_000)))
        return cables[-1]

    lab.pipes = cable
    lab.camera.configure(SETTINGS)
    captured_frames: list[CapturedFrame] = []
    failed = 0
    for number in range(FRAMES):
        if number % KILLED_EVERY == KILLED_EVERY - 1:
            # The host program dies and starts again.
            lab.camera = CanonEos(lab.open, lab.clock)
            lab.camera.configure(SETTINGS)
        for attempts_left in reversed(range(ATTEMPTS)):
            frames_before = len(lab.film.frames)
            try:
                with atomic_file(tmp_path / f"{number:04d}.cr2") as stream:
                    captured = capture(lab.camera, stream)
            except DeviceError as error:
                failed += 1
                if not attempts_left or isinstance(error, DeviceRefused):
                    raise
                continue
            assert len(lab.film.frames) > frames_before, "the frame was exposed in this attempt"
            captured_frames.append(captured)
            break
    lab.camera.close()
    numbers = [int(captured.name[4:8]) for captured in captured_frames]
    assert len(numbers) == FRAMES
    assert numbers == sorted(set(numbers)), "each frame once, in the order of exposure"
    for step, number in enumerate(numbers):
        assert (tmp_path / f"{step:04d}.cr2").read_bytes() == lab.film.frames[number - 1]
    assert len(list(tmp_path.iterdir())) == FRAMES
    assert min(body.fault_counts.values()) > 5, "every kind of fault occurred"
    assert failed > 0
    assert lab.waiting() == 0


class _Cable(CutOff):
    """A cable that can be unplugged, or breaks after some bytes."""

    def __init__(self, good: UsbPipes, lab: Lab, after: int) -> None:
        super().__init__(good, after)
        self._lab = lab

    def pull(self) -> None:
        """Unplug the cable; body and driver notice it."""
        self._remaining = 0
        self._lab.eos.unplugged()
