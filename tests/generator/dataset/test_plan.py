"""Plans: splits, options, shards and jobs."""

from __future__ import annotations

import math
from collections import Counter
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from foundation.errors import InputError
from generator.dataset.making import generate_dataset, parse_share
from generator.dataset.plan import DatasetOptions, Plan
from generator.dataset.shards import split_of
from generator.lights.lighting import ListedLights
from generator.pictures.random_scenes import random_scenes
from generator.pictures.sources import find_pictures
from tests.generator.conftest import MakeLut

SHARES = (0.7, 0.1, 0.2)


def test_split_shares_hold_on_average() -> None:
    count = 20_000
    splits = Counter(split_of(SHARES, 5, None, f"picture-{number}") for number in range(count))
    for split, share in zip(("train", "validation", "test"), SHARES, strict=True):
        # Six standard deviations of a binomial count: fails by chance once in 2·10⁸ runs.
        assert abs(splits[split] - share * count) < 6 * math.sqrt(count * share * (1 - share))  # pyrefly: ignore[bad-index]


@pytest.mark.slow
@given(st.text(), st.integers(0, 2**64 - 1), st.sampled_from([(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)]))
def test_share_of_1_gets_everything(name: str, seed: int, shares: tuple[float, float, float]) -> None:
    split = split_of(shares, seed, None, name)
    assert split == ("train", "validation", "test")[shares.index(1.0)]


def test_seeds_give_different_splits() -> None:
    first = [split_of((0.5, 0.0, 0.5), 1, None, str(number)) for number in range(200)]
    second = [split_of((0.5, 0.0, 0.5), 2, None, str(number)) for number in range(200)]
    # The number of equal splits is binomial (200, 1/2); it is outside 60 … 140 with probability 2·10⁻⁸.
    assert 60 < sum(a == b for a, b in zip(first, second, strict=True)) < 140
    assert split_of(None, 1, None, "a") is None


def write(path: Path, seed: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    codes = np.random.default_rng(seed).integers(0, 256, (6, 7, 3)).astype(np.uint8)
    path.write_bytes(cv2.imencode(".png", codes)[1].tobytes())


@pytest.mark.slow
def test_splits_depend_on_content_of_source(make_lut: MakeLut, tmp_path: Path) -> None:
    lut = make_lut()
    folder = tmp_path / "pictures"
    for number in range(12):
        write(folder / f"{number:02d}.png", number)
        write(folder / "copies" / f"copy of {number}.png", number)
    options = DatasetOptions(rendering="codes", previews=False, split=(0.5, 0.2, 0.3))
    data_set = generate_dataset(lut, tmp_path / "out", find_pictures([folder]), [0, 1, 2], seed=6, options=options)
    splits: dict[str, set[str | None]] = {}
    for entry in data_set.entries:
        splits.setdefault(entry.source, set()).add(entry.split)
    assert all(len(source_splits) == 1 for source_splits in splits.values()), "a source is in two splits"
    for number in range(12):
        assert splits[f"{number:02d}.png"] == splits[f"copies/copy of {number}.png"], (
            "copies of a file are in different splits"
        )
    for split in ("train", "validation", "test"):
        listed_images = (tmp_path / "out" / "splits" / f"{split}.txt").read_text().split()
        assert listed_images == [entry.image for entry in data_set.entries if entry.split == split]
        assert len(listed_images) == data_set.description.splits[split]
    assert {source.name: {source.split} for source in data_set.sources} == splits
    for number in range(12, 20):
        write(folder / f"0{number}.png", number)
    extended = generate_dataset(lut, tmp_path / "more", find_pictures([folder]), [3], seed=6, options=options)
    new_splits = {entry.source: {entry.split} for entry in extended.entries}
    assert {name: new_splits[name] for name in splits} == splits


def test_parses_share() -> None:
    assert parse_share("3/16") == (3, 16)
    for text in ("16/16", "3", "-1/4", "a/b", "3/"):
        with pytest.raises(InputError):
            parse_share(text)


@pytest.mark.parametrize(
    ("allowed", "refused"),
    [
        ({"crops": 1}, {"crops": 0}),
        ({"shard_images": 1}, {"shard_images": 0}),
        ({"split": (0.5, 0.0, 0.5 + 5e-7)}, {"split": (0.5, 0.0, 0.5 + 2e-6)}),
        ({"split": (0.0, 0.0, 1.0)}, {"split": (0.5, 0.5)}),
    ],
)
def test_option_limits(allowed: dict[str, Any], refused: dict[str, Any]) -> None:
    assert allowed.items() <= vars(DatasetOptions(**allowed)).items()
    with pytest.raises(InputError):
        DatasetOptions(**refused)


def test_plan_limits(make_lut: MakeLut) -> None:
    lut = make_lut(bits=2)

    def plan(crops: int = 1, **options: Any) -> Plan:
        return Plan(lut, random_scenes(1, 4, 4), ListedLights((0, 1)), 0, DatasetOptions(crops=crops, **options))

    full = plan(1 << 31, shard_images=1000)
    assert (full.total, full.shards, full.images_of(full.shards - 1)) == (1 << 32, 4_294_968, 296)
    with pytest.raises(InputError, match="4294967298 images"):
        plan((1 << 31) + 1)


def test_job_has_sources_of_its_images(make_lut: MakeLut) -> None:
    """Five pictures under two illuminants give images 0 to 9, in shards of three."""
    scenes = random_scenes(5, 4, 4)
    plan = Plan(make_lut(), scenes, ListedLights((0, 3)), 0, DatasetOptions(shard_images=3))
    jobs = [plan.job(shard) for shard in range(plan.shards)]
    assert [(job.first, job.stop, job.position) for job in jobs] == [(0, 3, 0), (3, 6, 1), (6, 9, 3), (9, 10, 4)]
    assert [[source.name[-1] for source in job.sources] for job in jobs] == [list("01"), list("12"), list("34"), ["4"]]
