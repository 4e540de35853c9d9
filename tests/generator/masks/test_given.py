"""Masks given as files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from foundation.errors import FormatError
from generator.masks.making import FULL, find_masks

if TYPE_CHECKING:
    pass

RAMP = np.tile(np.linspace(0, 1, 64), (48, 1))


def save(path: Path, values: npt.NDArray[Any], bits: int = 8) -> None:
    """Write a mask from 0 to 1, grey or RGB(A)."""
    scaled = np.rint(values * (2**bits - 1)).astype(np.uint8 if bits == 8 else np.uint16)
    if scaled.ndim == 3:
        scaled = scaled[..., [2, 1, 0, *range(3, scaled.shape[2])]]
    assert cv2.imwrite(str(path), scaled)


def test_one_mask_is_where_the_second_light_falls(tmp_path: Path) -> None:
    save(tmp_path / "a.png", RAMP, 16)
    maps = find_masks(tmp_path, 2).maker(0).weights(48, 64, 2)
    np.testing.assert_allclose(maps[..., 1], RAMP, atol=1 / FULL)
    np.testing.assert_array_equal(np.rint(maps.astype(np.float64) * FULL).sum(axis=2), FULL)


def test_as_many_masks_as_lights_are_divided_by_their_sum(tmp_path: Path) -> None:
    save(tmp_path / "a_7.png", np.full((48, 64), 0.2))
    save(tmp_path / "a_8.tif", np.full((48, 64), 0.6), 16)
    save(tmp_path / "a_10.png", np.zeros((48, 64)))
    maps = find_masks(tmp_path, 3).maker(0).weights(48, 64, 3)
    np.testing.assert_allclose(maps, np.broadcast_to([0.25, 0.75, 0], maps.shape), atol=1e-4)


def test_where_all_masks_are_dark_the_first_light_falls(tmp_path: Path) -> None:
    save(tmp_path / "a_1.png", np.zeros((4, 4)))
    save(tmp_path / "a_2.png", np.eye(4))
    maps = find_masks(tmp_path, 2).maker(0).weights(4, 4, 2)
    np.testing.assert_array_equal(maps[..., 1], np.eye(4))


def test_masks_that_overlap_leave_nothing_for_the_first_light(tmp_path: Path) -> None:
    save(tmp_path / "a_1.png", np.full((4, 4), 1.0))
    save(tmp_path / "a_2.png", np.full((4, 4), 1.0))
    maps = find_masks(tmp_path, 3).maker(0).weights(4, 4, 3)
    np.testing.assert_allclose(maps, np.broadcast_to([0, 0.5, 0.5], maps.shape), atol=1e-5)


def test_a_colour_picture_is_three_masks_and_a_grey_one_in_colour_is_one(tmp_path: Path) -> None:
    for name, colour, lights in (("colour", [0.2, 0.2, 0.4], 3), ("grey", [0.2, 0.2, 0.2], 2)):
        folder = tmp_path / name
        folder.mkdir()
        picture = np.broadcast_to(colour, (6, 5, 3))
        save(folder / "b.png", np.concatenate([picture, np.full((6, 5, 1), 0.3)], axis=2))
        maps = find_masks(folder, lights).maker(0).weights(6, 5, lights)
        expected = [0.25, 0.25, 0.5] if lights == 3 else [0.8, 0.2]
        np.testing.assert_allclose(maps, np.broadcast_to(expected, maps.shape), atol=1e-4)


def test_masks_are_made_to_fit_the_image(tmp_path: Path) -> None:
    save(tmp_path / "a.png", RAMP, 16)
    for height, width in ((12, 16), (96, 256), (96, 16)):
        maps = find_masks(tmp_path, 2).maker(0).weights(height, width, 2)
        ramp = np.clip(((np.arange(width) + 0.5) * 64 / width - 0.5) / 63, 0, 1)
        np.testing.assert_allclose(maps[..., 1], np.tile(ramp, (height, 1)), atol=2 / 63)


def test_sets_follow_one_another_by_name(tmp_path: Path) -> None:
    for name, value in (("b", 0.5), ("a", 0.25), ("c", 0.75)):
        save(tmp_path / f"{name}.png", np.full((2, 2), value), 16)
    (tmp_path / "notes.txt").write_text("not a mask")
    plan = find_masks(tmp_path, 2)
    found = [float(plan.maker(number).weights(2, 2, 2)[0, 0, 1]) for number in range(4)]
    np.testing.assert_allclose(found, [0.25, 0.5, 0.75, 0.25], atol=1e-4)
    described = plan.describe()
    assert (described["masks"], described["sets"]) == ("files", 3)
    save(tmp_path / "c.png", np.full((2, 2), 0.7), 16)
    assert find_masks(tmp_path, 2).describe()["sha256"] != described["sha256"]


@pytest.mark.parametrize(
    ("files", "lights", "message"),
    [
        ((), 2, "there is no mask in"),
        (
            ("a_1", "a_2", "a_3"),
            2,
            r"a_1\.png, a_2\.png, a_3\.png in .*: 2 lights need 2 masks, or 1 for those after the first; found 3",
        ),
        (("a",), 3, r"a\.png in .*: 3 lights need 3 masks, or 2 .* found 1"),
    ],
)
def test_a_set_of_the_wrong_size_is_named(tmp_path: Path, files: tuple[str, ...], lights: int, message: str) -> None:
    for name in files:
        save(tmp_path / f"{name}.png", np.ones((2, 2)))
    with pytest.raises(FormatError, match=message):
        find_masks(tmp_path, lights)


@pytest.mark.parametrize("data", [b"", b"no picture"])
def test_a_file_that_is_no_picture_is_named(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "bad.png").write_bytes(data)
    with pytest.raises(FormatError, match=r"bad\.png is no picture that can be read"):
        find_masks(tmp_path, 2)


def test_masks_of_a_dataset_go_to_the_images_of_their_numbers(tmp_path: Path) -> None:
    """Pictures that were passed over leave holes in the numbers."""
    for image, value in ((1, 0.25), (4, 0.5), (5, 0.75)):
        save(tmp_path / f"00000{image}_0.png", np.full((2, 2), 1 - value), 16)
        save(tmp_path / f"00000{image}_1.png", np.full((2, 2), value), 16)
    plan = find_masks(tmp_path, 2)
    found = [float(plan.maker(number).weights(2, 2, 2)[0, 0, 1]) for number in (1, 4, 5, 0)]
    np.testing.assert_allclose(found, [0.25, 0.5, 0.75, 0.25], atol=1e-4)


def test_files_of_a_camera_are_a_mask_each(tmp_path: Path) -> None:
    for number, value in ((1, 0.25), (2, 0.5)):
        save(tmp_path / f"IMG_000{number}.png", np.full((2, 2), value), 16)
    plan = find_masks(tmp_path, 2)
    found = [float(plan.maker(number).weights(2, 2, 2)[0, 0, 1]) for number in range(3)]
    np.testing.assert_allclose(found, [0.25, 0.5, 0.25], atol=1e-4)
