"""Masks from files and of every computed shape."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from foundation.errors import CropError, FormatError, InputError
from generator import philox
from generator.masks.making import (
    FULL,
    RandomStreams,
    Windows,
    find_masks,
    parse_masks,
    quantise_shares,
)
from tests.pinned import Pinned

RAMP = np.tile(np.linspace(0, 1, 64), (48, 1))


def save_mask(path: Path, values: npt.NDArray[Any], bits: int = 8) -> None:
    """Write a mask from 0 to 1, grey or RGB(A)."""
    scaled = np.rint(values * (2**bits - 1)).astype(np.uint8 if bits == 8 else np.uint16)
    if scaled.ndim == 3:
        scaled = scaled[..., [2, 1, 0, *range(3, scaled.shape[2])]]
    assert cv2.imwrite(str(path), scaled)


def test_single_mask_is_of_second_light(tmp_path: Path) -> None:
    save_mask(tmp_path / "a.png", RAMP, 16)
    maps = find_masks(tmp_path, 2).maker(0).weights(48, 64, 2)
    np.testing.assert_allclose(maps[..., 1], RAMP, atol=1 / FULL)
    np.testing.assert_array_equal(np.rint(maps.astype(np.float64) * FULL).sum(axis=2), FULL)


def test_limits_float_masks_to_weights(tmp_path: Path) -> None:
    values = np.array([[-0.5, 0.25], [0.75, 1.5]], np.float32)
    assert cv2.imwrite(str(tmp_path / "a.tif"), values, [cv2.IMWRITE_TIFF_COMPRESSION, 1])
    maps = find_masks(tmp_path, 2).maker(0).weights(2, 2, 2)
    np.testing.assert_allclose(maps[..., 1], [[0, 0.25], [0.75, 1]], atol=1 / FULL)


@pytest.mark.slow
def test_normalises_masks_of_all_lights(tmp_path: Path) -> None:
    save_mask(tmp_path / "a_7.png", np.full((48, 64), 0.2))
    save_mask(tmp_path / "a_8.tif", np.full((48, 64), 0.6), 16)
    save_mask(tmp_path / "a_10.png", np.zeros((48, 64)))
    maps = find_masks(tmp_path, 3).maker(0).weights(48, 64, 3)
    np.testing.assert_allclose(maps, np.broadcast_to([0.25, 0.75, 0], maps.shape), atol=1e-4)


def test_first_light_where_masks_are_zero(tmp_path: Path) -> None:
    save_mask(tmp_path / "a_1.png", np.zeros((4, 4)))
    save_mask(tmp_path / "a_2.png", np.eye(4))
    maps = find_masks(tmp_path, 2).maker(0).weights(4, 4, 2)
    np.testing.assert_array_equal(maps[..., 1], np.eye(4))


def test_overlapping_masks_leave_no_first_light(tmp_path: Path) -> None:
    save_mask(tmp_path / "a_1.png", np.full((4, 4), 1.0))
    save_mask(tmp_path / "a_2.png", np.full((4, 4), 1.0))
    maps = find_masks(tmp_path, 3).maker(0).weights(4, 4, 3)
    np.testing.assert_allclose(maps, np.broadcast_to([0, 0.5, 0.5], maps.shape), atol=1e-5)


def test_colour_file_has_three_masks_and_grey_file_one(tmp_path: Path) -> None:
    for name, colour, lights in (("colour", [0.2, 0.2, 0.4], 3), ("grey", [0.2, 0.2, 0.2], 2)):
        folder = tmp_path / name
        folder.mkdir()
        picture = np.broadcast_to(colour, (6, 5, 3))
        save_mask(folder / "b.png", np.concatenate([picture, np.full((6, 5, 1), 0.3)], axis=2))
        maps = find_masks(folder, lights).maker(0).weights(6, 5, lights)
        expected = [0.25, 0.25, 0.5] if lights == 3 else [0.8, 0.2]
        np.testing.assert_allclose(maps, np.broadcast_to(expected, maps.shape), atol=1e-4)


def test_resizes_masks_to_image(tmp_path: Path) -> None:
    save_mask(tmp_path / "a.png", RAMP, 16)
    for height, width in ((12, 16), (96, 256), (96, 16)):
        maps = find_masks(tmp_path, 2).maker(0).weights(height, width, 2)
        ramp = np.clip(((np.arange(width) + 0.5) * 64 / width - 0.5) / 63, 0, 1)
        np.testing.assert_allclose(maps[..., 1], np.tile(ramp, (height, 1)), atol=2 / 63)


def test_uses_sets_in_order_of_names(tmp_path: Path) -> None:
    for name, value in (("b", 0.5), ("a", 0.25), ("c", 0.75)):
        save_mask(tmp_path / f"{name}.png", np.full((2, 2), value), 16)
    (tmp_path / "notes.txt").write_text("not a mask")
    plan = find_masks(tmp_path, 2)
    second_weights = [float(plan.maker(number).weights(2, 2, 2)[0, 0, 1]) for number in range(4)]
    np.testing.assert_allclose(second_weights, [0.25, 0.5, 0.75, 0.25], atol=1e-4)
    described = plan.describe()
    assert (described["masks"], described["sets"]) == ("files", 3)
    save_mask(tmp_path / "c.png", np.full((2, 2), 0.7), 16)
    assert find_masks(tmp_path, 2).describe()["sha256"] != described["sha256"]


def numbered_masks(folder: Path) -> dict[str, float]:
    """Write masks of three pictures, whose numbers have one or two digits, and return their values."""
    values = {"img1": 0.25, "img2": 0.5, "img10": 0.75}
    for name, value in values.items():
        save_mask(folder / f"{name}_1.png", np.full((2, 2), value), 16)
    return values


@pytest.mark.parametrize("order", [("img1", "img10", "img2"), ("img10", "img1"), ("img2",)])
def test_pairs_masks_with_pictures_by_name(tmp_path: Path, order: tuple[str, ...]) -> None:
    values = numbered_masks(tmp_path)
    plan = find_masks(tmp_path, 2).paired([f"sub/{name}.jpg" for name in order], images_each=2)
    second_weights = [float(plan.maker(number).weights(2, 2, 2)[0, 0, 1]) for number in range(2 * len(order))]
    np.testing.assert_allclose(second_weights, np.repeat([values[name] for name in order], 2), atol=1e-4)
    assert plan.describe()["pairing"] == "names"


def test_other_names_take_masks_in_natural_order(tmp_path: Path) -> None:
    numbered_masks(tmp_path)
    plan = find_masks(tmp_path, 2).paired(["a.png", "b.png", "c.png"], images_each=1)
    second_weights = [float(plan.maker(number).weights(2, 2, 2)[0, 0, 1]) for number in range(3)]
    np.testing.assert_allclose(second_weights, [0.25, 0.5, 0.75], atol=1e-4)
    assert "pairing" not in plan.describe()


def test_refuses_masks_of_only_some_pictures(tmp_path: Path) -> None:
    numbered_masks(tmp_path)
    with pytest.raises(InputError, match=r"1 of 2 pictures .*other\.png"):
        find_masks(tmp_path, 2).paired(["img1.png", "other.png"], images_each=1)


@pytest.mark.parametrize("data", [b"", b"no picture"])
def test_refuses_unreadable_mask(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "bad.png").write_bytes(data)
    with pytest.raises(FormatError, match=r"bad\.png cannot be read"):
        find_masks(tmp_path, 2)


def test_assigns_numbered_masks_to_images(tmp_path: Path) -> None:
    # Skipped pictures leave gaps in the numbers.
    for image, value in ((1, 0.25), (4, 0.5), (5, 0.75)):
        save_mask(tmp_path / f"00000{image}_0.png", np.full((2, 2), 1 - value), 16)
        save_mask(tmp_path / f"00000{image}_1.png", np.full((2, 2), value), 16)
    plan = find_masks(tmp_path, 2)
    second_weights = [float(plan.maker(number).weights(2, 2, 2)[0, 0, 1]) for number in (1, 4, 5, 0)]
    np.testing.assert_allclose(second_weights, [0.25, 0.5, 0.75, 0.25], atol=1e-4)


def test_camera_file_names_are_single_masks(tmp_path: Path) -> None:
    for number, value in ((1, 0.25), (2, 0.5)):
        save_mask(tmp_path / f"IMG_000{number}.png", np.full((2, 2), value), 16)
    plan = find_masks(tmp_path, 2)
    second_weights = [float(plan.maker(number).weights(2, 2, 2)[0, 0, 1]) for number in range(3)]
    np.testing.assert_allclose(second_weights, [0.25, 0.5, 0.25], atol=1e-4)


SHAPES = ("half-plane", "soft-edge", "spots", "smooth", "window")

Map = npt.NDArray[np.float32]


def weights(text: str, height: int, width: int, lights: int = 2, seed: int = 0, number: int = 0) -> Map:
    return parse_masks(text, lights, seed).maker(number).weights(height, width, lights)


def reduced(fine: Map, height: int, width: int) -> Map:
    return np.asarray(cv2.resize(fine, (width, height), interpolation=cv2.INTER_AREA), dtype=np.float32)


@pytest.mark.slow
@given(
    st.sampled_from(SHAPES),
    st.integers(1, 90),
    st.integers(1, 90),
    st.integers(2, 5),
    st.integers(0, 2**64 - 1),
    st.integers(0, 2**32 - 1),
)
@settings(max_examples=60)
def test_weights_are_quantised_and_sum_to_one(
    shape: str, height: int, width: int, lights: int, seed: int, number: int
) -> None:
    maps = weights(shape, height, width, lights, seed, number)
    assert (maps.shape, maps.dtype) == ((height, width, lights), np.float32)
    quantised = np.rint(maps.astype(np.float64) * FULL)
    np.testing.assert_array_equal((quantised / FULL).astype(np.float32), maps)
    np.testing.assert_array_equal(quantised.sum(axis=2), FULL)
    assert quantised.min() >= 0


@pytest.mark.slow
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("lights", [2, 3])
def test_masks_look_equal_at_every_size(shape: str, lights: int) -> None:
    for number in range(4):
        fine = weights(shape, 480, 640, lights, number=number)
        coarse = weights(shape, 96, 128, lights, number=number)
        difference = np.abs(reduced(fine, 96, 128) - coarse)
        # Only the few pixels on an edge may differ.
        assert difference.mean() < 0.004
        assert np.quantile(difference, 0.97) < 0.05


@pytest.mark.parametrize("shape", SHAPES)
def test_masks_differ_between_images_and_seeds(shape: str) -> None:
    first = weights(shape, 60, 80)
    np.testing.assert_array_equal(first, weights(shape, 60, 80))
    for changed in (weights(shape, 60, 80, number=1), weights(shape, 60, 80, seed=1)):
        assert np.abs(first - changed).mean() > 0.01


@pytest.mark.slow
@pytest.mark.parametrize("shape", SHAPES)
def test_every_light_gets_a_share(shape: str) -> None:
    shares = np.array([weights(shape, 30, 40, 3, number=number).mean(axis=(0, 1)) for number in range(40)])
    assert shares.mean(axis=0).min() > 0.08
    assert (shares > 0.01).mean() > 0.8


def test_half_plane_angle() -> None:
    # The first illuminant is on the left, then above.
    across = weights("half-plane:angle=0", 40, 80)
    assert across[:, 0, 0].min() == 1
    assert across[:, -1, 1].min() == 1
    np.testing.assert_array_equal(across, np.broadcast_to(across[:1], across.shape))
    down = weights("half-plane:angle=90", 40, 80)
    assert down[0, :, 0].min() == 1
    assert down[-1, :, 1].min() == 1
    # A sharp edge is one pixel wide.
    assert ((across[0, :, 0] > 0) & (across[0, :, 0] < 1)).sum() <= 1


def test_strips_are_in_order() -> None:
    strips = weights("half-plane:angle=0", 4, 300, 4)
    assert strips[0].argmax(axis=1).tolist() == sorted(strips[0].argmax(axis=1))
    assert set(strips[0].argmax(axis=1)) == {0, 1, 2, 3}


def test_soft_edge_width() -> None:
    edge = weights("soft-edge:angle=0,width=.5", 3, 1000)[0, :, 1]
    between = np.flatnonzero((edge > 0) & (edge < 1))
    assert len(between) == pytest.approx(500, abs=6)
    middle = between.mean()
    x = ((np.arange(1000) - middle) / 500 + 0.5).clip(0, 1)
    np.testing.assert_allclose(edge, 3 * x**2 - 2 * x**3, atol=2e-3)


def test_spot_sizes() -> None:
    for number in range(6):
        spot = weights("spots:count=1,radius=.1,softness=.5", 400, 400, number=number)[..., 1]
        if (spot > 0)[[0, -1]].any() or (spot > 0)[:, [0, -1]].any():
            continue
        # The share is 0.5 at 40 px and 0 beyond 50 px; areas of discs.
        assert (spot >= 0.5).sum() == pytest.approx(np.pi * 40**2, rel=0.03)
        assert (spot > 0).sum() == pytest.approx(np.pi * 50**2, rel=0.03)
        assert (spot == 1).sum() == pytest.approx(np.pi * 30**2, rel=0.03)
        break
    else:
        pytest.fail("no spot lies within the picture")


def test_smooth_field_scale() -> None:
    def mean_gradient(scale: float) -> float:
        return float(
            np.mean(
                [
                    np.abs(np.diff(weights(f"smooth:scale={scale}", 200, 200, number=number)[..., 0], axis=1)).mean()
                    for number in range(8)
                ]
            )
        )

    assert mean_gradient(0.1) / mean_gradient(0.4) == pytest.approx(4, rel=0.35)
    flat = weights("smooth:contrast=0", 50, 50, 4)
    np.testing.assert_allclose(flat, 0.25, atol=2 / FULL)
    # The gradient is limited by the scale, and there are no seams between pieces of the spline.
    field = weights("smooth:scale=.5", 400, 400)[..., 0].astype(np.float64)
    assert np.abs(np.diff(field, axis=1)).max() < 0.06
    assert np.abs(np.diff(field, n=2, axis=0)).max() < 0.006


@pytest.mark.slow
def test_window_position() -> None:
    drawn = np.full(64, 0.5)
    # A small window, a tenth of the width to the left and equally far down.
    half, drawn[[0, 2, 3]] = (0.5, 0.375), (0, 0.3, 0.5 + 0.1 / 0.375)

    class Drawn(RandomStreams):
        def uniform(self, stream: int, count: int = 64) -> npt.NDArray[np.float64]:
            del stream
            return drawn[:count]

    u, v = np.linspace(-0.5, 0.5, 201)[None], np.linspace(-0.375, 0.375, 151)[:, None]
    lit = Windows(1, 1, 0.02).shares(Drawn(0, 0), half, 2, 0.005, u)(v)[1] > 0.5
    rows, columns = np.nonzero(lit)
    assert (u[0, columns].mean(), v[rows, 0].mean()) == pytest.approx((-0.1, 0.1), abs=0.006)


def test_window_panes() -> None:
    for number in range(20):
        lit = weights("window:columns=3,rows=2,softness=0.002", 400, 400, number=number)[..., 1] > 0.5
        if lit[[0, -1]].any() or lit[:, [0, -1]].any():
            continue
        count, _, stats, _ = cv2.connectedComponentsWithStats(lit.astype(np.uint8))
        areas = stats[1:, cv2.CC_STAT_AREA]
        assert count - 1 == 6
        assert areas.min() > 0.1 * areas.max()
        break
    else:
        pytest.fail("no window lies within the picture")


def test_largest_share_absorbs_rounding() -> None:
    out = np.empty((1, 1, 3), np.float32)
    quantise_shares(np.array([1, 1, 1.0001], np.float32).reshape(3, 1, 1), out)
    assert np.rint(out * FULL).ravel().tolist() == [21844, 21844, 21847]


@given(hnp.arrays(np.float32, (2, 3, 37), elements=st.floats(0, 1, width=32)))
def test_two_lights_equal_three_with_a_dark_one(shares: npt.NDArray[np.float32]) -> None:
    shares[0] += np.float32(2**-20) * (shares.sum(axis=0) == 0)
    two, three = np.empty((3, 37, 2), np.float32), np.empty((3, 37, 3), np.float32)
    quantise_shares(shares, two)
    quantise_shares(np.concatenate([shares, np.zeros_like(shares[:1])]), three)
    np.testing.assert_array_equal(three, np.dstack([two, np.zeros((3, 37))]))


TEXTS = (
    "half-plane",
    "half-plane:angle=90",
    "half-plane:angle=-30,width=.3",
    "soft-edge",
    "soft-edge:angle=200,width=0",
    "spots",
    "spots:count=1,radius=1,softness=2",
    "spots:count=20,radius=.05,softness=0",
    "smooth",
    "smooth:scale=2",
    "smooth:scale=.02,contrast=100",
    "smooth:contrast=0",
    "window",
    "window:columns=1,rows=1,softness=0",
    "window:columns=5,rows=2,softness=.3",
)

REFUSED = ("window:columns=1.5", "spots:count=0", "spots:count=21", "smooth:scale=.01", "half", "smooth:radius=1", "")


@pytest.mark.slow
def test_pinned_masks(pinned: Pinned) -> None:
    results: dict[str, Any] = {}
    for text in TEXTS:
        for lights in (2, 3, 5):
            plan = parse_masks(text, lights, 2**35 + 4)
            weight_maps = [
                plan.maker(number).weights(height, width, lights)
                for number, (height, width) in enumerate(((11, 14), (16, 5), (1, 1), (1, 9)))
            ]
            results[f"{text} {lights}"] = [
                plan.describe(),
                weight_maps[0][5, ::5],
                b"".join(weights.tobytes() for weights in weight_maps),
            ]
    for text in REFUSED:
        with pytest.raises(CropError) as refused:
            parse_masks(text, 2, 0)
        results[text] = str(refused.value)
    # More rows than are computed at once.
    results["tall"] = parse_masks("smooth", 2, 1).maker(0).weights(1200, 60, 2)
    pinned("masks of every kind", results)


@pytest.mark.slow
def test_streams_use_philox_words() -> None:
    words = philox.words(2**40 + 9, np.arange(5), 2, 7, philox.MASKS)[0]
    np.testing.assert_allclose(RandomStreams(2**40 + 9, 7).uniform(2, 5), (words + 0.5) / 2**32, rtol=1e-15)
