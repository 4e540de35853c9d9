"""The file of a real data set's statistics, as the generator reads it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from foundation.errors import FormatError
from generator.lights.ground_truths import load_ground_truths
from generator.statistics import read_statistics
from tests.generator.statistics.stats_files import write_stats

LIGHTS = [[0.3, 0.4, 0.3], [0.4, 0.4, 0.2], [0.2, 0.5, 0.3]]


def test_what_a_file_says(tmp_path: Path) -> None:
    path = write_stats(tmp_path / "s.json", LIGHTS, {"grey_red": [0.1, float("nan"), -0.2]})
    # A number that is not known is written as null.
    path.write_text(path.read_text().replace("NaN", "null"))
    found = read_statistics(path)
    assert (found.name, found.cells, found.images, found.sizes) == ("real", 64, 3, ((60, 40, 3),))
    assert found.lights.tolist() == LIGHTS
    assert found.known("grey_red").tolist() == [0.1, -0.2]
    assert found.known("no such number").size == 0


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"version": 2}, "version 2; expected crop.statistics, version 1"),
        ({"format": "crop.dataset"}, "is of format crop.dataset"),
        ({"lights": []}, "lights of shape"),
        ({"lights": [[0.5, 0.5]]}, "lights of shape"),
        ({"lights": [[0.5, 0.0, 0.5]]}, "above 0"),
        ({"lights": [[0.5, float("inf"), 0.5]]}, "above 0"),
        ({"lights": [[0.5, float("nan"), 0.5]]}, "above 0"),
        ({"values": {"grey_red": [1.0]}}, "numbers of 3 images expected of grey_red"),
        ({"values": None}, "not as its format has it"),
        ({"data": {}}, "KeyError"),
    ],
)
def test_what_is_no_such_file(tmp_path: Path, change: dict[str, object], told: str) -> None:
    path = write_stats(tmp_path / "s.json", LIGHTS, {"grey_red": [0, 1, 2]}, **change)
    with pytest.raises(FormatError, match=told) as caught:
        read_statistics(path)
    assert str(path) in str(caught.value)
    assert "evaluate describe" in str(caught.value)


@pytest.mark.parametrize("text", ["", "{", "[1]", '"crop.statistics"', "\udcff".encode("utf-8", "surrogateescape")])
def test_damage(tmp_path: Path, text: str | bytes) -> None:
    path = tmp_path / "s.json"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    with pytest.raises(FormatError, match="evaluate describe"):
        read_statistics(path)
    with pytest.raises(FormatError, match="evaluate describe"):
        load_ground_truths(path)


def test_lights_of_a_file_are_ground_truths(tmp_path: Path) -> None:
    path = write_stats(tmp_path / "s.json", LIGHTS, {})
    assert load_ground_truths(path).tolist() == LIGHTS
    content = json.loads(path.read_text())
    del content["lights"]
    path.write_text(json.dumps(content))
    with pytest.raises(FormatError, match="has no lights"):
        load_ground_truths(path)


def test_images_encoded_for_a_display_are_told_from_linear_ones(tmp_path: Path) -> None:
    linear = np.random.default_rng(2).lognormal(np.log(0.16), 0.6, 200)
    encoded = 1.055 * linear ** (1 / 2.4) - 0.055
    found = [
        read_statistics(write_stats(tmp_path / f"{name}.json", LIGHTS, {"luminance_50": values}))
        for name, values in (("linear", linear), ("encoded", encoded))
    ]
    assert [made.may_be_encoded for made in found] == [False, True]
