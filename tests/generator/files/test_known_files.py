"""Bytes of files, previews and scales of images that are easily packed wrong, as they were before.

Who changes the bytes of an image's file changes every dataset: one that is made again is to be the same.
"""

from __future__ import annotations

import struct
from bisect import bisect_left
from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from foundation.errors import FormatError
from generator import files
from generator.deflate import code_lengths, codes_of
from generator.files import (
    ImageMetadata,
    decode_image,
    encode_dng,
    encode_exr,
    encode_image,
    encode_map,
    encode_tiff,
    fit_flash,
    flash,
    from_full_scale,
    half_size,
    mosaic_of,
    preview_of,
    require_plausible,
    to_full_scale,
)
from tests.pinned import Pinned

pytestmark = pytest.mark.slow

METADATA = ImageMetadata(white_level=4600, white=(4000.0, 2520.0, 840.5), camera="Known camera")
OF_A_BODY = ImageMetadata(white_level=11536, white=(2046.0, 1579.5, 4520.0), camera="Canon EOS 550D")


def images() -> Iterator[tuple[str, npt.NDArray[Any]]]:
    """Yield images with runs of every length, repeats at the ends of the window, few and many values, odd sizes."""
    rng = np.random.default_rng(8)
    few = rng.integers(0, 4000, (9, 3))
    for height, width in ((1, 1), (1, 2), (2, 1), (3, 7), (1, 300), (300, 1)):
        yield f"noise {height}x{width}", rng.integers(0, 65536, (height, width, 3))
    runs = np.repeat(few[np.arange(90) % 9], np.arange(90), axis=0)
    yield "runs", runs[: 89 * 45].reshape(45, 89, 3)
    yield "one colour", np.full((40, 50, 3), 1234)
    yield "black", np.zeros((30, 30, 3))
    for shift in (-1, 0, 1):
        # The same noise again, just within, at and just beyond 32768 bytes: 60 rows of 91 pixels and a byte each.
        once = rng.integers(0, 5000, (60, 91 + shift, 3))
        yield f"repeats {shift}", np.concatenate([once, once, once])
    yield "a few colours", few[rng.integers(0, 9, (64, 64))]
    yield "many rows of few colours", few[rng.geometric(0.4, (200, 60)) % 9]
    yield "25 of each of 64", rng.integers(0, 4000, (1600, 3))[rng.integers(0, 1600, (80, 120))]
    yield "rare bytes", np.where(rng.random((90, 90, 1)) < 0.001, rng.integers(0, 65536, (90, 90, 3)), few[:1])
    ramp = np.arange(90 * 70).reshape(90, 70, 1) * np.array([1, 3, 7])
    yield "a ramp", ramp % 65536
    index = np.arange(640 * 480).reshape(640, 480, 1)
    # Of so many symbols one row of eight is counted.
    yield "samples of cells", (index * index // 97 % 40) * [31, 97, 55] + (index * 2654435761 >> 7) % 25 * [3, 10, 6]
    yield "a noisy ramp", ramp // 8 + rng.poisson(20, (90, 70, 3))


def test_files_of_images(pinned: Pinned, monkeypatch: pytest.MonkeyPatch) -> None:
    found: dict[str, Any] = {}
    for name, numbers in images():
        image = numbers.astype(np.uint16)
        found[name] = {
            "png": encode_image(image, "png", METADATA),
            "tiff": encode_tiff(image, METADATA),
            "exr": encode_exr(image, METADATA)[:340],
        }
        # Maps are packed by a library, whose versions may differ: that they come to less is known.
        assert len(encode_map(image[..., 1])) < 100 + image.nbytes
        if min(image.shape[:2]) >= 22:
            found[name]["dng"] = encode_dng(image, METADATA) + encode_dng(image, OF_A_BODY)
        # In bands of some rows, the last of them shorter.
        with monkeypatch.context() as changed:
            changed.setattr(files, "BAND", 7 * image.shape[1] + 3)
            found[name]["png in bands"] = encode_image(image, "png", OF_A_BODY)
    pinned("bytes of images' files", found)


def test_codes(pinned: Pinned) -> None:
    rng = np.random.default_rng(9)
    found: list[Any] = []
    given: list[npt.NDArray[np.int64]] = [np.array([0, 0, 5]), np.array([0, 3, 3]), np.zeros(4, np.int64)]
    given += [rng.geometric(part, 60) * (rng.random(60) < 0.7) for part in (0.01, 0.2, 0.9)]
    given += [2 ** np.arange(25), np.array([1, 1, 2, 3, 5, 8, 13, 21, 34, 55, 89, 144])]
    for counts in given:
        for longest in (7, 12, 15):
            lengths = code_lengths(counts, longest)
            found.append([lengths, codes_of(lengths)])
    pinned("codes of frequencies", found)


def test_previews_and_scales(pinned: Pinned) -> None:
    rng = np.random.default_rng(10)
    found: dict[str, Any] = {}
    for height, width, side in ((40, 30, 40), (41, 30, 40), (40, 80, 40), (81, 33, 40), (37, 120, 40), (3, 200, 9)):
        image = np.minimum(rng.exponential(500, (height, width, 3)), 5000).astype(np.uint16)
        image[0, :2] = 0
        preview = preview_of(image, 4600, side)
        found[f"{height}x{width} in {side}"] = [preview, np.bincount(preview.ravel(), minlength=256)]
    linear = rng.exponential(0.1, (20, 30, 3))
    found["dark"] = preview_of(np.zeros((4, 4, 3), np.uint16), 100, 2)
    for a, gamma in ((5.0, 2.2), (1.0, 1.0), (20.0, 3.0)):
        fitted = fit_flash(linear, a, gamma)
        codes = fitted.apply(linear)
        found[f"flash {a} {gamma}"] = [
            fitted,
            codes,
            fitted.invert(codes),
            fitted.invert(np.rint(codes)),
            flash(linear, a, gamma),
        ]
    counts = np.array([0, 1, 2, 99, 100, 101, 4599, 4600, 4601, 65535], np.uint16)
    for white in (1, 100, 4600, 32767, 32768, 65535):
        found[f"scale {white}"] = [to_full_scale(counts, white), from_full_scale(counts, white)]
    mosaic = mosaic_of(rng.integers(0, 65536, (7, 9, 3)).astype(np.uint16))
    found["mosaic"] = [mosaic, half_size(mosaic), half_size(mosaic[:6, 1:])]
    # A code may be off by one where another processor rounds a power otherwise.
    pinned("previews and scales", found, same=1e-4)


def test_what_a_head_may_claim(pinned: Pinned) -> None:
    """The most rows that a file of 200 bytes may claim, by bits and kind of colour; and how long a part may be."""

    def is_plausible(data: bytes) -> bool:
        try:
            require_plausible(data, "it")
        except FormatError:
            return False
        return True

    def head(rows: int, depth: int, colour: int, size: int = 13) -> bytes:
        return b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sIIBB", size, b"IHDR", 61, rows, depth, colour) + bytes(7)

    found: dict[str, Any] = {}
    for depth in (1, 8, 16):
        for colour in range(8):
            rows = range(1 << 20)
            found[f"{depth} {colour}"] = bisect_left(
                rows, True, key=lambda many, d=depth, c=colour: not is_plausible(head(many, d, c) + bytes(167))
            )
    parts = [head(1, 8, 2)[:length] + struct.pack(">I", size) + bytes(8) for length in (32, 33) for size in range(4)]
    parts += [head(1, 8, 2, size) for size in (12, 13, 14)] + [head(1, 8, 2)[:length] for length in (7, 25, 26, 32)]
    found["parts"] = [is_plausible(part) for part in parts]
    pinned("what a head may claim", found)


def test_images_come_back(pinned: Pinned) -> None:
    image = np.random.default_rng(12).integers(0, 65536, (23, 25, 3)).astype(np.uint16)
    forms: tuple[files.Format, ...] = ("png", "tiff", "exr", "dng")
    pinned(
        "images that come back",
        [decode_image(encode_image(image, form, OF_A_BODY), form, "it").tobytes() for form in forms],
    )
