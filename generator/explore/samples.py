"""Pictures to begin with, for those who name none: shaded balls, patches with greys, and random colours.

They are computed, so that nobody's photographs have to go with the package, and kept as files, so that a command can
name them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from foundation.colorimetry import srgb_codes
from foundation.errors import InputError
from foundation.files import cache_folder, sha256_of, write_whole
from generator.pictures.sources import Picture, RandomScene

_WIDTH: Final = 900
"""Width of the pictures, px: as much as a page shows without making them smaller."""

_HEIGHT: Final = 600
"""Height, px."""

_BALLS: Final = (
    ((160, 395, 130), (0.78, 0.05, 0.04)),
    ((395, 330, 175), (0.85, 0.55, 0.06)),
    ((655, 400, 135), (0.06, 0.33, 0.62)),
    ((800, 280, 75), (0.70, 0.70, 0.70)),
    ((285, 520, 60), (0.10, 0.45, 0.12)),
    ((520, 530, 65), (0.45, 0.10, 0.50)),
    ((765, 535, 45), (0.90, 0.90, 0.88)),
)
"""Balls: centre and radius, px, and linear sRGB of the surface, back to front."""

_FROM: Final = np.array([-0.5, -0.65, 0.57])
"""Direction to the lamp: right, down, towards the viewer."""

_PATCHES: Final = 6
"""Patches in a row: hues, and below them greys."""


def sample_folder(cache: Path | None = None) -> Path:
    """Return the folder of the sample pictures, made if it is not there.

    `cache`: where it is kept; None for `foundation.files.cache_folder`.
    """
    import cv2

    cache = cache or cache_folder()
    if cache is None:
        raise InputError(
            "the sample pictures need a place to be kept, and there is no home folder; set XDG_CACHE_HOME, or name "
            "pictures with --sources"
        )
    pictures = {"balls": _balls(), "patches": _patches(), "random": _random()}
    key = sha256_of(b"".join(picture.tobytes() for picture in pictures.values()))[:12]
    folder = cache / f"pictures-{key}"
    for name, picture in pictures.items():
        path = folder / f"{name}.png"
        if not path.is_file():
            write_whole(path, cv2.imencode(".png", picture[..., ::-1])[1].tobytes())
    return folder


def _balls() -> Picture:
    """Return matt balls with a highlight on a grey table before a wall, under one lamp."""
    y, x = np.mgrid[:_HEIGHT, :_WIDTH].astype(np.float64)
    lamp = _FROM / np.linalg.norm(_FROM)
    floor = y > 0.55 * _HEIGHT
    fall = 1.0 - 0.45 * np.hypot((x - 250) / _WIDTH, (y - 150) / _HEIGHT)
    linear = (np.where(floor, 0.30, 0.42) * fall)[..., None] * np.ones(3)
    for (left, top, radius), _ in _BALLS:
        away = np.hypot((x - left - 0.55 * radius) / (1.25 * radius), (y - top - 0.85 * radius) / (0.35 * radius))
        linear *= (1 - 0.6 * np.clip(1.3 - away, 0, 1) * floor)[..., None]
    for (left, top, radius), surface in _BALLS:
        across, down = (x - left) / radius, (y - top) / radius
        towards = np.sqrt(np.maximum(1 - across**2 - down**2, 0.0))
        facing = np.maximum(across * lamp[0] + down * lamp[1] + towards * lamp[2], 0.0)
        mirrored = np.maximum(2 * facing * towards - lamp[2], 0.0)
        shaded = np.array(surface) * (0.12 + 0.95 * facing)[..., None] + 0.5 * mirrored[..., None] ** 40
        cover = np.clip(radius - np.hypot(x - left, y - top) + 0.5, 0, 1)[..., None]
        linear += cover * (shaded - linear)
    return srgb_codes(np.clip(linear, 0, 1))


def _patches() -> Picture:
    """Return patches of six hues at three saturations above a row of greys from black to white."""
    hues = np.arange(_PATCHES) / _PATCHES
    wheel = 0.5 + 0.5 * np.cos(2 * np.pi * (hues[:, None] - np.array([0.0, 1 / 3, 2 / 3])))
    rows = [0.25 + part * (wheel - 0.5) for part in (0.4, 0.25, 0.1)]
    greys = np.repeat(np.linspace(0, 1, _PATCHES)[:, None] ** 2.2, 3, axis=1)
    patches = srgb_codes(np.clip(np.stack([*rows, greys]), 0, 1))
    side = _WIDTH // _PATCHES
    return _enlarged(patches, side)


def _random() -> Picture:
    """Return blocks of uniformly random colours, each of ten by ten pixels."""
    return _enlarged(RandomScene(0, _WIDTH // 10, _HEIGHT // 10).read().picture, 10)


def _enlarged(small: npt.NDArray[np.uint8], times: int) -> Picture:
    return np.ascontiguousarray(small.repeat(times, axis=0).repeat(times, axis=1))
