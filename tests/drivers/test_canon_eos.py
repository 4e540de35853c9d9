"""The EOS driver against a recorded EOS 60D, and against scripted bodies that speak the recorded layouts."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from drivers.camera import CameraIdentity, ExposureSettings
from drivers.errors import DeviceRefused
from drivers.ptp.canon_eos import CanonEos
from drivers.ptp.codes import Operation
from drivers.ptp.messages import Event, Request, Response
from drivers.ptp.transport import Transaction
from sim.clock import SimulatedClock


@pytest.fixture(scope="session")
def recording() -> list[dict[str, Any]]:
    path = Path(__file__).parents[2].parent / "shared" / "data" / "ptp" / "eos60d_transactions.json"
    if not path.is_file():
        pytest.skip("the recorded conversation is not on this machine")
    return json.loads(path.read_text())


class Recorded:
    """A cable on which a recorded body answers as it did; what it was not asked then, it does not know now."""

    label = "the recorded EOS 60D"

    def __init__(self, transactions: list[dict[str, Any]]) -> None:
        self.left = list(transactions)
        self.transactions: list[int] = []
        self.asked: list[tuple[int, tuple[int, ...], bytes | None]] = []
        self.closed = False

    def transact(
        self,
        request: Request,
        *,
        send: bytes | None = None,
        receive: Callable[[bytes], object] | None = None,
        timeout: float,
    ) -> Transaction:
        assert receive is None
        assert timeout > 0
        self.transactions.append(request.transaction)
        self.asked.append((request.code, request.parameters, send))
        sent = None if send is None else send.hex()
        for number, known in enumerate(self.left):
            data = known["data"] if known["dir"] == "out" else None
            if int(known["code"], 16) == request.code and tuple(known["params"]) == request.parameters and data == sent:
                self.left = self.left[number + 1 :]
                answer = bytes.fromhex(known["data"]) if known["dir"] == "in" else b""
                return Transaction(Response(int(known["rc"], 16), request.transaction, tuple(known["rparams"])), answer)
        pytest.fail(f"the recorded host did not ask {request} with {sent} here")

    def events(self) -> tuple[Event, ...]:
        return ()

    def reset(self) -> None:
        pytest.fail("a healthy cable is not reset")

    def close(self) -> None:
        self.closed = True


def test_speaks_as_the_recorded_host_did(recording: list[dict[str, Any]]) -> None:
    cable = Recorded(recording[:37])
    camera = CanonEos(lambda: cable, SimulatedClock())
    assert camera.identity() == CameraIdentity("Canon Inc.", "Canon EOS 60D", "1280627086", "3-1.1.0")
    camera.close()
    camera.close()
    assert cable.closed
    assert cable.transactions == list(range(len(cable.transactions)))
    assert cable.left == [], "the last of the recorded transactions is the last of ours"
    assert [code for code, _, _ in cable.asked if code != Operation.EOS_GET_EVENT] == [
        0x1002, 0x1001, 0x9114, 0x9115, 0x9127, 0x9110, 0x911A, 0x9110, 0x9114, 0x9115, 0x1003,
    ]  # fmt: skip


def test_a_recorded_body_that_is_not_set_up_is_refused_with_all_reasons_at_once(
    recording: list[dict[str, Any]],
) -> None:
    cable = Recorded([*recording[:22], *[recording[6]] * 10])
    camera = CanonEos(lambda: cable, SimulatedClock())
    with pytest.raises(DeviceRefused) as caught:
        camera.configure(ExposureSettings(iso=110, aperture=8, shutter_s=0.5))
    assert str(caught.value) == (
        "the camera cannot take the series: the mode dial stands at aperture priority: turn it to M; "
        "the drive mode is continuous high: set single shooting; "
        "ISO speed 110 is not offered; near it: 100, 125, 160, 200; "
        "shutter time 0.5 is not offered; near it: nothing, the list is empty"
    )
