"""One process has a lock; others are refused with its number."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Generator
from contextlib import contextmanager

import pytest

from foundation.errors import DeviceRefused
from foundation.holds import hold

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="names of sockets without files are Linux's")


@contextmanager
def held_elsewhere(key: str) -> Generator[int]:
    """Let another process lock a key while the block runs; yield its number."""
    program = f"from foundation.holds import hold\nwith hold('it', {key!r}): print('held', flush=True), input()"
    with subprocess.Popen([sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"held\n"
        yield process.pid
        process.communicate(b"\n")


def test_refusal_names_the_process() -> None:
    with held_elsewhere("test_holds one") as pid:
        for _ in range(3):
            with pytest.raises(DeviceRefused, match=f"process {pid}") as refusal, hold("the lab", "test_holds one"):
                pass
            assert refusal.value.value == pid
        with hold("another lab", "test_holds two"):
            pass
    with hold("the lab", "test_holds one"):
        pass


def test_killed_process_releases_its_lock() -> None:
    with held_elsewhere("test_holds killed") as pid:
        subprocess.run(["kill", "-KILL", str(pid)], check=True)
        while True:
            try:
                with hold("the lab", "test_holds killed"):
                    break
            except DeviceRefused:
                continue


def test_process_may_lock_twice() -> None:
    with hold("the lab", "test_holds twice"), hold("the lab", "test_holds twice"):
        pass
