"""The independent PTP/IP initiator ptpy with the simulated camera.

ptpy 0.3.2 requires construct 2.8.8, with which its PTP/IP does not work; it works with 2.8.12. Therefore no extra lists
it; `.ci/run` installs both. Its Canon extension divides record sizes by `/`, as in Python 2, and reads no events in
Python 3, so it is used as a generic still camera initiator.
"""

from __future__ import annotations

import hashlib
import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

from foundation.clock import SimulatedClock
from sim.buses.ptp import serve_ptpip
from sim.camera.bodies import TEST_BODY
from sim.camera.eos import SimulatedEos
from tests.contracts.camera import SeededFilm

pytestmark = pytest.mark.slow

SCRIPT = """
import collections, collections.abc, hashlib, sys
collections.Sequence = collections.abc.Sequence  # construct 2.8 looks for it there
import ptpy
camera = ptpy.PTPy(device=("127.0.0.1", int(sys.argv[1])), transport=ptpy.IP, raw=True)
with camera.session():
    info = camera.get_device_info()
    print(info.Manufacturer, info.Model, "GetPartialObject" in info.OperationsSupported)
    (card,) = camera.get_storage_ids()
    for handle in camera.get_object_handles(card, all_storage_ids=False):
        entry = camera.get_object_info(handle)
        if entry.ObjectFormat != "Association":
            data = camera.get_object(handle).Data
            part = camera.get_partial_object(handle, 1000, 500).Data
            print(entry.Filename, hashlib.sha256(data).hexdigest(), part == data[1000:1500])
"""


@pytest.mark.skipif(importlib.util.find_spec("ptpy") is None, reason="ptpy is not installed, see .ci/run")
def test_ptpy_downloads_frames_on_card(tmp_path: Path) -> None:
    film, clock = SeededFilm(70_000), SimulatedClock()
    eos = SimulatedEos(TEST_BODY, film, clock, auto_power_off_s=0)
    for _ in range(2):
        eos._full_press()
        clock.sleep(5)
        assert not eos.busy
    with serve_ptpip(eos, 0) as server:
        process = subprocess.run(
            [sys.executable, "-c", SCRIPT, str(server.address[1])],
            cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False,
        )  # fmt: skip
    assert process.returncode == 0, process.stderr
    head, *frames = process.stdout.splitlines()
    assert head == "Canon Inc. CroP Test True"
    assert frames == [
        f"IMG_{number:04d}{film.suffix.upper()} {hashlib.sha256(data).hexdigest()} True"
        for number, data in enumerate(film.frames, 1)
    ]
