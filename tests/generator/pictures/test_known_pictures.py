"""Codes of known pictures of every kind of file, depth, transparency, profile and preparation, as they were before."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from generator.pictures.conversion import from_adobe_rgb, to_srgb
from generator.pictures.random_scenes import RandomScene, random_scenes
from generator.pictures.sources import (
    Preparation,
    clear_bits,
    open_picture,
    random_places,
)
from tests.generator.pictures.icc import ADOBE_RGB, PROPHOTO_RGB, gamma_profile
from tests.generator.pictures.oiio_files import write
from tests.generator.said import said
from tests.pinned import Pinned

pytestmark = pytest.mark.slow

RNG = np.random.default_rng(21)
CODES = RNG.integers(0, 256, (6, 9, 4)).astype(np.uint8)
WIDE = RNG.integers(0, 65536, (5, 7, 4)).astype(np.uint16)
WIDE[0, :4, 0] = (128, 129, 65407, 65535)
LIGHT = RNG.uniform(-0.2, 1.6, (5, 6, 4)).astype(np.float32)
LIGHT[0, :3, 0] = (np.nan, np.inf, -np.inf)
LIGHT[..., 3] = np.clip(LIGHT[..., 3], 0, 1)


def written(folder: Path) -> list[Path]:
    """Write a picture of every kind and return their paths."""
    for channels in (1, 2, 3, 4):
        write(folder / f"bytes{channels}.png", CODES[..., :channels], "uint8")
        write(folder / f"wide{channels}.tif", WIDE[..., :channels], "uint16")
        write(folder / f"light{channels}.exr", LIGHT[..., :channels], "half")
    write(folder / "words.png", WIDE[..., :3], "uint16")
    write(folder / "encoded.tif", LIGHT[1:, :, :3], "float", oiio__ColorSpace="sRGB")
    write(folder / "encoded.exr", LIGHT[1:, :, :3], "float", oiio__ColorSpace="sRGB")
    write(folder / "apart.tif", CODES, "uint8", oiio__UnassociatedAlpha=1)
    multiplied = (CODES / 255.0 * CODES[..., 3:]).astype(np.uint8)
    write(folder / "multiplied.tif", np.concatenate([multiplied[..., :3], CODES[..., 3:]], axis=-1), "uint8")
    for orientation in range(1, 10):
        write(folder / f"turned{orientation}.tif", CODES[..., :3], "uint8", Orientation=orientation)
    profiles = {
        "adobe": gamma_profile("Adobe", 563 / 256, ADOBE_RGB),
        "prophoto": gamma_profile("Pro", 1.8, PROPHOTO_RGB),
    }
    profiles |= {"grey": gamma_profile("Grey", 1.8, None), "bad": b"no profile"}
    for name, icc in profiles.items():
        Image.fromarray(CODES[..., :3]).save(folder / f"profile-{name}.png", icc_profile=icc)
        Image.fromarray(CODES[..., 0]).save(folder / f"profile-{name}-grey.png", icc_profile=icc)
    for suffix in ("bmp", "ppm", "gif", "tga", "webp"):
        Image.fromarray(CODES[..., :3]).save(folder / f"other.{suffix}", lossless=True)
    cut = (folder / "bytes3.png").read_bytes()
    (folder / "cut.png").write_bytes(cut[:-30])
    (folder / "flipped.png").write_bytes(cut[:60] + bytes([cut[60] ^ 1]) + cut[61:])
    (folder / "empty.png").touch()
    return sorted(folder.iterdir())


def test_pictures_of_every_kind(tmp_path: Path, pinned: Pinned) -> None:
    found: dict[str, Any] = {}
    for path in written(tmp_path):
        read = said(open_picture, path)
        if isinstance(read, dict):
            found[path.name] = read
            continue
        found[path.name] = [read.picture.shape, read.picture, read.profile, read.notes]
        if "profile" in path.name:
            found[path.name].append(open_picture(path, Preparation(profiles="ignore")).profile)
    found["too many"] = said(open_picture, tmp_path / "bytes3.png", Preparation(), None, None, 53)
    found["as many"] = open_picture(tmp_path / "bytes3.png", Preparation(), None, None, 54).picture.shape
    # Profiles and half numbers are converted by libraries, whose versions may differ by a code.
    pinned("pictures of every kind", found, same=1e-3)


def test_prepared_pictures(tmp_path: Path, pinned: Pinned) -> None:
    y, x = np.mgrid[:41, :63]
    codes = np.stack([4 * x, 6 * y, (x * y) % 256], axis=-1).astype(np.uint8)
    (tmp_path / "a.png").write_bytes(cv2.imencode(".png", codes)[1].tobytes())
    found: dict[str, Any] = {}
    given: list[dict[str, Any]] = [{}, *({"max_side": side} for side in (63, 62, 20, 1))]
    given += [{"crop": size} for size in ((63, 41), (64, 41), (10, 12))]
    given += [{"crop": (20, 20), "cover": True}, {"crop": (10, 12), "crop_at": "random", "seed": 5}]
    given += [{"max_side": 30, "crop": (30, 10), "cover": True, "seed": 3, "crops": 4}]
    given += [{"crop": (62, 40), "crops": 4, "seed": 1}, {"crop": (62, 40), "crops": 5}]
    given += [{"crop": (8, 8), "crop_at": "centre", "seed": 2, "crops": 3}]
    given += [{"crop": (40, 3), "cover": True, "crop_at": "random", "seed": 9}]
    preparations = [Preparation(**one) for one in given]
    for number, preparation in enumerate(preparations):
        read = said(open_picture, tmp_path / "a.png", preparation)
        cuts = read if isinstance(read, dict) else [
            read.picture.shape, read.picture, [[cut.left, cut.top, cut.picture[0, 0]] for cut in read.cuts]
        ]  # fmt: skip
        found[str(number)] = [preparation.describe(), preparation.place, cuts]
    wrong: list[dict[str, Any]] = [
        {"max_side": 0},
        {"crop": (0, 3)},
        {"crop": (65536, 1)},
        {"cover": True},
        {"crops": 0},
    ]
    wrong += [{"crops": 2}, {"crop_at": "random"}, {"max_side": 8, "crop": (9, 3)}, {"crop": (65535, 1)}]
    found["refused"] = [said(Preparation, **one) for one in wrong]
    free = ((1, 1, 1), (2, 2, 4), (5, 3, 15), (300, 200, 6), (40, 1, 9))
    found["places"] = [
        random_places((across, down), (16, 12), count, 2**40 + 1, name, first)
        for across, down, count in free
        for name in ("a.png", "é")
        for first in (None, (across // 2, down // 2))
    ]
    bits = np.arange(256, dtype=np.uint8)[::7]
    found["bits"] = [
        clear_bits(bits, 0),
        clear_bits(bits, 5),
        clear_bits(bits, 8),
    ]
    scenes = random_scenes(3, 7, 5, 2**33 + 2)
    found["scenes"] = [
        [scene.name, scene.to_json(), scene.read().picture] for scene in (*scenes, RandomScene(9, 1, 1, 0))
    ]
    found["no scenes"] = [said(random_scenes, *given) for given in ((0, 4, 4), (1, 0, 4), (1, 65536, 1), (-1, 4, 4))]
    pinned("prepared pictures", found, same=1e-4)


def test_codes_of_other_spaces(pinned: Pinned) -> None:
    ramp = np.stack([np.arange(256)] * 3, axis=-1)[None].astype(np.uint8)
    some = RNG.integers(0, 256, (300, 5, 3)).astype(np.uint8)
    found: list[Any] = [from_adobe_rgb(codes) for codes in (ramp, some)]
    for gamma, space in ((563 / 256, ADOBE_RGB), (1.8, PROPHOTO_RGB), (1.8, None), (2.2, None)):
        found += [to_srgb(codes, gamma_profile("mine", gamma, space)) for codes in (ramp, some[:20])]
    pinned("codes of other spaces", found, same=1e-3)
