"""A small LUT with known statistics, and pictures."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from calibration.table.lut import Lut, Provenance, Unfit, open_lut
from calibration.table.writing import LutWriter
from drivers.presenter import Colour
from experiment.lights import Illuminant
from generator import philox

SAMPLES = 25
MakeLut = Callable[..., Lut]


def expected_means(bits: int, light: int) -> npt.NDArray[np.float64]:
    """Return the means (8**bits, 3) of the samples of `make_lut`."""
    index: npt.NDArray[np.int64] = np.arange(8**bits, dtype=np.int64)
    mask = (1 << bits) - 1
    code = np.stack([index >> 2 * bits & mask, index >> bits & mask, index & mask], axis=-1) / mask
    return 200 + 3000 * code * np.array([1 + 0.2 * light, 1.0, 1.4 - 0.2 * light])


def lut_in(folder: Path, bits: int = 2, lights: int = 4, unfit: tuple[int, ...] = ()) -> Lut:
    """Make a LUT with Poisson samples."""
    folder.mkdir()
    rng = np.random.default_rng(20190601)
    writer = LutWriter(folder, lights, 8**bits, SAMPLES)
    plan: list[Illuminant] = []
    white: list[npt.NDArray[np.float64]] = []
    for light in range(lights):
        means = expected_means(bits, light)
        writer.put(light, rng.poisson(means[:, None, :].repeat(SAMPLES, axis=1)).astype(np.uint16))
        is_body = light % 2 == 1
        plan.append(
            Illuminant(
                light,
                "blackbody" if is_body else "uniform",
                3000.0 + light if is_body else None,
                Colour(9, 8, light),
            )
        )
        white.append(means[-1])
    writer.finish(
        plan,
        np.array(white),
        Provenance(
            camera="Test camera",
            bits=bits,
            white_level=8000,
            session_sha256="1" * 64,
            chart_sha256="2" * 64,
            software="test 1",
            unfit=[Unfit(colour=colour, cause="a test") for colour in unfit],
        ),
    )
    return open_lut(folder)


@pytest.fixture
def make_lut(tmp_path: Path) -> MakeLut:
    """Return a function that makes LUTs with Poisson samples."""

    def make(bits: int = 2, lights: int = 4, unfit: tuple[int, ...] = (), name: str = "lut") -> Lut:
        return lut_in(tmp_path / name, bits, lights, unfit)

    return make


@pytest.fixture
def table_and_picture(make_lut: MakeLut, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Change to a folder with a LUT of four illuminants, `lut`, and a picture of 50×40 px, `cat.png`."""
    make_lut()
    codes = np.random.default_rng(3).integers(0, 256, (40, 50, 3)).astype(np.uint8)
    (tmp_path / "cat.png").write_bytes(cv2.imencode(".png", codes)[1].tobytes())
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def picture() -> npt.NDArray[np.uint8]:
    """Return a picture of random codes with an irregular size."""
    return np.random.default_rng(5).integers(0, 256, (37, 1053, 3)).astype(np.uint8)


Rule = Callable[..., npt.NDArray[np.int64]]


def sample_numbers(
    seed: int, image: int, height: int, width: int, *, first_row: int = 0, place: int = 0, count: int = SAMPLES
) -> npt.NDArray[np.int64]:
    """Return the sample numbers (H, W) by the rule in `generator/kernels/choice.py`, with numpy."""
    y, x = np.arange(first_row, first_row + height), np.arange(width)
    keys = [key.astype(np.uint64)[:, None] for key in philox.words(seed, y, place, image, philox.SAMPLES)[:3]]
    word, low = np.uint64(0xFFFFFFFF), np.uint64(32)
    h = (8 * (x // 16) + x % 8).astype(np.uint64)[None] ^ keys[0]
    h = (h * np.uint64(0x21F0AAAD) & word) ^ keys[1]
    h = ((h ^ (h >> np.uint64(16))) * np.uint64(0x735A2D97) & word) ^ keys[2]
    h = (h ^ (h >> np.uint64(15))) * np.uint64(0x31848BAB) & word
    p = h * np.uint64(count)
    q = (p & word) * np.uint64(count)
    return np.where(x % 16 < 8, p >> low, q >> low).astype(np.int64)


@pytest.fixture(scope="session")
def rule() -> Rule:
    """Return `sample_numbers`."""
    return sample_numbers
