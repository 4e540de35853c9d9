"""Small prints and rooms, shared by tests, because rendering takes a part of a second."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Generator
from contextlib import contextmanager

import numpy as np
import pytest

from sim.world.rendering import Print
from sim.world.sensors import BODIES
from sim.world.world import Room, World

PAGE_MM = (180.0, 125.0)
BARE = Print(PAGE_MM, np.empty((0, 4)), np.empty((0, 3), dtype=np.uint8))
"""A sheet on which nothing is printed."""


def squares() -> Print:
    """Twelve black squares of 12.3 mm at irregular positions, far from each other."""
    x, y = np.meshgrid([25.37, 66.11, 107.83, 151.29], [24.71, 61.05, 99.43])
    centres = np.stack([x.ravel(), y.ravel()], axis=-1)
    boxes = np.concatenate([centres - 6.15, centres + 6.15], axis=1)
    return Print(PAGE_MM, boxes, np.zeros((len(boxes), 3), dtype=np.uint8))


def patches() -> Print:
    """Thirty-five patches of 24 mm: seven by five colours."""
    x, y = (grid.ravel() for grid in np.meshgrid(6 + 24.0 * np.arange(7), 2.5 + 24.0 * np.arange(5)))
    rgb = np.random.default_rng(5).integers(0, 32, (35, 3)) * 8
    rgb[:3] = [[0, 0, 0], [255, 255, 255], [128, 128, 128]]
    return Print(PAGE_MM, np.stack([x, y, x + 24, y + 24], axis=-1).astype(np.float64), rgb.astype(np.uint8))


@contextmanager
def sim_serving(*arguments: str, lines: int = 1) -> Generator[list[str]]:
    """Run `sim` as a program, yield the first lines of its output, and interrupt it."""
    command = [sys.executable, "-c", "from sim.cli import main; raise SystemExit(main())", *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            yield [process.stdout.readline() for _ in range(lines)]
            process.send_signal(signal.SIGINT)
            out, err = process.communicate(timeout=30)
        finally:
            process.kill()
    assert (process.returncode, out, err) == (0, "stopped\n", "")


@pytest.fixture(scope="session")
def world() -> World:
    """Patches in a room with default parameters and the test body."""
    return World(patches(), BODIES["Test"], Room())


@pytest.fixture(scope="session")
def plain_world() -> World:
    """Patches in a room without black leak, with equal photosites."""
    return World(patches(), BODIES["Test"], Room(black_leak=0, response_spread=0))


@pytest.fixture(scope="session")
def square_world() -> World:
    """Black squares in uniform light on a wavy, rotated page, with strong distortion and blur."""
    room = Room(
        tilt_deg=4, pan_deg=-6, roll_deg=1.5, k1=-0.15, waviness_mm=27, fill=0.9, focal_diagonals=1.1, blur_px=0.8,
        vignetting=0, projector_falloff=0, response_spread=0, black_leak=0,
    )  # fmt: skip
    return World(squares(), BODIES["Test"], room)
