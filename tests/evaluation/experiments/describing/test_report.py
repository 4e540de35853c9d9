"""Figures of two sets are told apart where they differ, and not where they do not.

What is said of two descriptions before they are compared.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from evaluation.experiments.describing import DataDescription, describe, figures
from evaluation.experiments.describing.description import QUANTITIES, read_statistics, statistics_to_json
from evaluation.experiments.describing.report import FigureCompared, compare_figures, seen_notes, sentence
from generator.likeness.real_data import TITLES
from tests.evaluation.experiments.describing.scenes import random_set

pytestmark = pytest.mark.slow


def compared(one: DataDescription, other: DataDescription) -> dict[str, FigureCompared]:
    return {made.quantity.name: made for made in compare_figures(one, other)}


def test_a_set_beside_itself_and_beside_one_of_its_kind() -> None:
    first = describe(random_set("a", 60))
    for made in compare_figures(first, first):
        assert made.verdict in ("yes", "yes?")
        assert made.distance == 0
        assert made.change[0] == pytest.approx(0 if made.quantity.signed else 1)
    again = compared(first, describe(random_set("b", 60, seed=1)))
    assert {made.verdict for made in again.values()} <= {"yes", "yes?", "no?"}
    assert again["chroma_spread"].verdict == "yes"
    assert "exposure" not in again


def test_pale_images_are_told() -> None:
    pale, real = describe(random_set("pale", 60, chroma=0.1)), describe(random_set("real", 60, seed=1))
    found = compared(pale, real)
    assert found["chroma_spread"].verdict == "no"
    assert found["chroma_spread"].change[0] == pytest.approx(0.5, abs=0.05)
    assert found["chroma_spread"].distance == 1
    assert found["luminance_50"].verdict in ("yes", "yes?")
    assert figures(pale)["log_red_spread"] == pytest.approx(0.1 * np.sqrt(2), rel=0.05)
    told = sentence(found["chroma_spread"], ("pale", "real"))
    assert "in pale" in told
    assert told.endswith("not within 25%.")


def test_offsets_are_measured_by_the_others_spread() -> None:
    redder = describe(random_set("redder", 80, light=(0.6, 1, 0.7)))
    found = compared(redder, describe(random_set("real", 80, seed=1)))["light_red"]
    assert found.change[0] == pytest.approx(np.log(0.6 / 0.5), abs=0.15)
    assert found.scale == pytest.approx(0.2 * np.sqrt(2), rel=0.25)
    assert found.verdict in ("no", "no?")
    assert "of its spread there" in sentence(found, ("redder", "real"))


def test_a_ratio_to_nothing_is_none() -> None:
    real = describe(random_set("real", 20))
    values = {**real.values, "clipped": np.zeros(20)}
    none = replace(real, values=values)
    some = replace(real, values={**values, "clipped": np.full(20, 0.01)})
    found = compared(some, none)["clipped"]
    assert found.verdict is None
    assert np.isnan(found.change[0])
    assert sentence(found, ("a", "b")).endswith("no ratio to a figure that is 0.")


def test_figures_of_too_few_images_are_left_out() -> None:
    real = describe(random_set("real", 20))
    rare = {**real.values, "noise": np.array([0.1, 0.1, *[np.nan] * 18])}
    assert "noise" not in compared(replace(real, values=rare), real)


def test_intervals_of_spreads_are_those_of_normal_distributions() -> None:
    random = np.random.default_rng(5)
    real = describe(random_set("real", 3))
    one, other = random.normal(0, 1.5, 500), random.normal(0, 1, 500)
    sets = [
        replace(real, values={**dict.fromkeys(real.values, np.full(500, np.nan)), "grey_red": values})
        for values in (one, other)
    ]
    # The logarithm of a standard deviation of N values has a variance of 1 / 2N.
    half = 1.96 * np.sqrt(1 / 1000 + 1 / 1000)
    expected = one.std() / other.std() * np.exp([0, -half, half])
    np.testing.assert_allclose(compared(*sets)["grey_spread_red"].change, expected, rtol=0.02)


def test_generate_calls_figures_by_the_same_names() -> None:
    titles = {quantity.name: quantity.title for quantity in QUANTITIES}
    assert {name: titles[name] for name in TITLES} == TITLES


def test_only_images_that_share_a_picture_make_intervals_too_narrow(tmp_path: Path) -> None:
    alone = replace(describe(random_set("alone", 4)), layout="generated")
    assert alone.groups == len(alone.images)
    shared = replace(alone, name="shared", groups=2)
    (tmp_path / "shared.json").write_text(statistics_to_json(shared))
    read = read_statistics(str(tmp_path / "shared.json"))
    assert read.groups == 2
    (told,) = [note for note in seen_notes(alone, read) if "too narrow" in note]
    assert told.startswith(f"The {len(alone.images)} images of shared are of 2 pictures or places")
