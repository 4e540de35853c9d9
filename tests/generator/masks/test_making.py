"""Masks of every kind: shares that sum to 1, shapes by their numbers, files, and the same masks for a seed."""

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

from foundation.errors import CropError, FormatError
from generator import philox
from generator.masks.making import (
    FULL,
    RandomStreams,
    Windows,
    find_masks,
    parse_masks,
    quantise_shares,
)
from generator.masks.maps import (
    decode_ground_truth,
    decode_weights,
    encode_maps,
    mean_weights,
    quantised_chromaticities,
    quantised_weights,
)
from tests.pinned import Pinned

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


@pytest.mark.slow
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


@pytest.mark.parametrize("data", [b"", b"no picture"])
def test_a_file_that_is_no_picture_is_named(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "bad.png").write_bytes(data)
    with pytest.raises(FormatError, match=r"bad\.png is no picture"):
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


KINDS = ("half-plane", "soft-edge", "spots", "smooth", "window")

Map = npt.NDArray[np.float32]


def weights(text: str, height: int, width: int, lights: int = 2, seed: int = 0, number: int = 0) -> Map:
    return parse_masks(text, lights, seed).maker(number).weights(height, width, lights)


def shrunk(fine: Map, height: int, width: int) -> Map:
    return np.asarray(cv2.resize(fine, (width, height), interpolation=cv2.INTER_AREA), dtype=np.float32)


@pytest.mark.slow
@given(
    st.sampled_from(KINDS),
    st.integers(1, 90),
    st.integers(1, 90),
    st.integers(2, 5),
    st.integers(0, 2**64 - 1),
    st.integers(0, 2**32 - 1),
)
@settings(max_examples=60)
def test_weights_are_whole_parts_that_sum_to_one(
    kind: str, height: int, width: int, lights: int, seed: int, number: int
) -> None:
    maps = weights(kind, height, width, lights, seed, number)
    assert (maps.shape, maps.dtype) == ((height, width, lights), np.float32)
    parts = np.rint(maps.astype(np.float64) * FULL)
    np.testing.assert_array_equal((parts / FULL).astype(np.float32), maps)
    np.testing.assert_array_equal(parts.sum(axis=2), FULL)
    assert parts.min() >= 0


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("lights", [2, 3])
def test_the_same_look_at_every_size(kind: str, lights: int) -> None:
    for number in range(4):
        fine = weights(kind, 480, 640, lights, number=number)
        coarse = weights(kind, 96, 128, lights, number=number)
        off = np.abs(shrunk(fine, 96, 128) - coarse)
        # Only pixels that an edge crosses may differ, by less than the edge; edges are few.
        assert off.mean() < 0.004
        assert np.quantile(off, 0.97) < 0.05


@pytest.mark.parametrize("kind", KINDS)
def test_every_image_and_seed_has_masks_of_its_own(kind: str) -> None:
    first = weights(kind, 60, 80)
    np.testing.assert_array_equal(first, weights(kind, 60, 80))
    for other in (weights(kind, 60, 80, number=1), weights(kind, 60, 80, seed=1)):
        assert np.abs(first - other).mean() > 0.01


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_every_light_falls_somewhere(kind: str) -> None:
    """Over forty images each of three lights gets its share; over one, none is left out but by chance."""
    shares = np.array([weights(kind, 30, 40, 3, number=number).mean(axis=(0, 1)) for number in range(40)])
    assert shares.mean(axis=0).min() > 0.08
    assert (shares > 0.01).mean() > 0.8


def test_a_half_plane_has_its_angle() -> None:
    # The first light on the left, the second on the right; then the first above, the second below.
    across = weights("half-plane:angle=0", 40, 80)
    assert across[:, 0, 0].min() == 1
    assert across[:, -1, 1].min() == 1
    np.testing.assert_array_equal(across, np.broadcast_to(across[:1], across.shape))
    down = weights("half-plane:angle=90", 40, 80)
    assert down[0, :, 0].min() == 1
    assert down[-1, :, 1].min() == 1
    # A sharp edge is one pixel wide.
    assert ((across[0, :, 0] > 0) & (across[0, :, 0] < 1)).sum() <= 1


def test_strips_follow_one_another() -> None:
    strips = weights("half-plane:angle=0", 4, 300, 4)
    assert strips[0].argmax(axis=1).tolist() == sorted(strips[0].argmax(axis=1))
    assert set(strips[0].argmax(axis=1)) == {0, 1, 2, 3}


def test_a_soft_edge_has_its_width() -> None:
    edge = weights("soft-edge:angle=0,width=.5", 3, 1000)[0, :, 1]
    between = np.flatnonzero((edge > 0) & (edge < 1))
    assert len(between) == pytest.approx(500, abs=6)
    middle = between.mean()
    x = ((np.arange(1000) - middle) / 500 + 0.5).clip(0, 1)
    np.testing.assert_allclose(edge, 3 * x**2 - 2 * x**3, atol=2e-3)


def test_spots_have_their_size() -> None:
    for number in range(6):
        spot = weights("spots:count=1,radius=.1,softness=.5", 400, 400, number=number)[..., 1]
        if (spot > 0)[[0, -1]].any() or (spot > 0)[:, [0, -1]].any():
            continue
        # Half its light within 40 px; nothing beyond 40 + 10; by areas of discs.
        assert (spot >= 0.5).sum() == pytest.approx(np.pi * 40**2, rel=0.03)
        assert (spot > 0).sum() == pytest.approx(np.pi * 50**2, rel=0.03)
        assert (spot == 1).sum() == pytest.approx(np.pi * 30**2, rel=0.03)
        break
    else:
        pytest.fail("no spot lies within the picture")


def test_smooth_fields_change_over_their_scale() -> None:
    def steepness(scale: float) -> float:
        return float(
            np.mean(
                [
                    np.abs(np.diff(weights(f"smooth:scale={scale}", 200, 200, number=number)[..., 0], axis=1)).mean()
                    for number in range(8)
                ]
            )
        )

    assert steepness(0.1) / steepness(0.4) == pytest.approx(4, rel=0.35)
    flat = weights("smooth:contrast=0", 50, 50, 4)
    np.testing.assert_allclose(flat, 0.25, atol=2 / FULL)
    # Nothing is steeper than an edge of the scale; there is no seam where pieces of the spline meet.
    field = weights("smooth:scale=.5", 400, 400)[..., 0].astype(np.float64)
    assert np.abs(np.diff(field, axis=1)).max() < 0.06
    assert np.abs(np.diff(field, n=2, axis=0)).max() < 0.006


@pytest.mark.slow
def test_a_window_lies_where_it_was_drawn() -> None:
    drawn = np.full(64, 0.5)
    # A small one, a tenth of the picture's width to the left and as far down.
    half, drawn[[0, 2, 3]] = (0.5, 0.375), (0, 0.3, 0.5 + 0.1 / 0.375)

    class Drawn(RandomStreams):
        def uniform(self, stream: int, count: int = 64) -> npt.NDArray[np.float64]:
            del stream
            return drawn[:count]

    u, v = np.linspace(-0.5, 0.5, 201)[None], np.linspace(-0.375, 0.375, 151)[:, None]
    lit = Windows(1, 1, 0.02).shares(Drawn(0, 0), half, 2, 0.005, u)(v)[1] > 0.5
    rows, columns = np.nonzero(lit)
    assert (u[0, columns].mean(), v[rows, 0].mean()) == pytest.approx((-0.1, 0.1), abs=0.006)


def test_windows_have_their_panes() -> None:
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


def test_whole_parts_give_what_is_left_to_the_largest() -> None:
    out = np.empty((1, 1, 3), np.float32)
    quantise_shares(np.array([1, 1, 1.0001], np.float32).reshape(3, 1, 1), out)
    assert np.rint(out * FULL).ravel().tolist() == [21844, 21844, 21847]


@given(hnp.arrays(np.float32, (2, 3, 37), elements=st.floats(0, 1, width=32)))
def test_whole_parts_of_two_are_those_of_three_one_of_which_is_dark(shares: npt.NDArray[np.float32]) -> None:
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
def test_masks_of_every_kind(pinned: Pinned) -> None:
    found: dict[str, Any] = {}
    for text in TEXTS:
        for lights in (2, 3, 5):
            plan = parse_masks(text, lights, 2**35 + 4)
            made = [
                plan.maker(number).weights(height, width, lights)
                for number, (height, width) in enumerate(((11, 14), (16, 5), (1, 1), (1, 9)))
            ]
            found[f"{text} {lights}"] = [
                plan.describe(),
                made[0][5, ::5],
                b"".join(weights.tobytes() for weights in made),
            ]
    for text in REFUSED:
        with pytest.raises(CropError) as refused:
            parse_masks(text, 2, 0)
        found[text] = str(refused.value)
    # More rows than are computed at a time.
    found["tall"] = parse_masks("smooth", 2, 1).maker(0).weights(1200, 60, 2)
    pinned("masks of every kind", found)


@pytest.mark.slow
def test_masks_of_files(pinned: Pinned, tmp_path: Path) -> None:
    rng = np.random.default_rng(13)
    found: dict[str, Any] = {}
    given = {
        "one": {"a_1.png": rng.integers(0, 256, (6, 8), np.uint8)},
        "both": {
            "a_1.png": rng.integers(0, 256, (6, 8), np.uint8),
            "a_2.png": rng.integers(0, 65536, (6, 8), np.uint16),
        },
        "sets": {f"{name}.png": rng.integers(0, 3, (5, 5), np.uint8) * 127 for name in ("c", "b_10", "b_2", "a")},
        "colour": {"a.png": rng.integers(0, 256, (6, 8, 3), np.uint8)},
        "grey": {"a.png": np.repeat(rng.integers(0, 256, (6, 8, 1), np.uint8), 3, axis=2)},
        "numbered": {f"{number:06d}_1.png": rng.integers(0, 256, (3, 3), np.uint8) for number in (7, 2, 100)},
        "float": {"a_1.tiff": rng.uniform(-0.5, 1.5, (6, 8)).astype(np.float32)},
        "none": {},
    }
    for name, files in given.items():
        folder = tmp_path / name
        folder.mkdir()
        for file, values in files.items():
            (folder / file).write_bytes(cv2.imencode(Path(file).suffix, values)[1].tobytes())
        for lights in (2, 3):
            try:
                plan = find_masks(folder, lights)
                described = {key: value for key, value in plan.describe().items() if key != "sha256"}
                sizes = ((6, 8), (3, 4), (12, 17), (3, 16))
                masks = [plan.maker(number).weights(*size, lights) for number, size in enumerate(sizes)]
                found[f"{name} {lights}"] = [described, [maker.files for maker in plan.sets], plan.places, masks]
            except CropError as error:
                found[f"{name} {lights}"] = str(error).replace(str(tmp_path), "PLACE")
    # Sizes are fitted by a library, to whole 65535ths after that.
    pinned("masks of files", found, nothing=2e-5)


@pytest.mark.slow
def test_maps_of_weights(pinned: Pinned) -> None:
    rng = np.random.default_rng(14)
    found: dict[str, Any] = {}
    for lights in (1, 2, 3, 6):
        shares = (rng.random((lights, 5, 7)) ** 3).astype(np.float32)
        shares[0, 0, :3] = shares[-1, 0, :3] = 0.25
        weights = np.empty((5, 7, lights), np.float32)
        quantise_shares(shares, weights)
        whites = rng.uniform(0.1, 5000, (lights, 3))
        maps = encode_maps(weights, whites)
        masks = [data for kind, _, data in maps if "mask" in kind]
        found[str(lights)] = [
            weights, quantised_weights(weights, 65535), quantised_weights(weights, 255), mean_weights(weights),
            quantised_chromaticities(weights, whites, 65535), [[kind, name] for kind, name, _ in maps],
            decode_weights(masks, "masks") if masks else None,
            decode_ground_truth(maps[-1][2], "map") if maps else None,
        ]  # fmt: skip
    pinned("maps of weights", found)


@pytest.mark.slow
def test_streams_are_of_the_words() -> None:
    words = philox.words(2**40 + 9, np.arange(5), 2, 7, philox.MASKS)[0]
    np.testing.assert_allclose(RandomStreams(2**40 + 9, 7).uniform(2, 5), (words + 0.5) / 2**32, rtol=1e-15)
