"""Data sets of table 1, errors of methods in cases with a known answer, and figures of the print."""

from __future__ import annotations

import numpy as np
import pytest

from evaluation.experiments.paper.published import TABLE1
from evaluation.experiments.paper.table1 import (
    Block,
    noise_table,
    plan_blocks,
    printed_colours_table,
    table1,
    table2,
)
from evaluation.methods.prepared import unit
from evaluation.metrics import recovery_error
from generator.pictures.random_scenes import random_scenes
from tests.evaluation.experiments.paper.conftest import LIGHTS, TableMaker
from tests.evaluation.experiments.transfer.worlds import MeanLearner
from tests.evaluation.made_scenes import Made

TRUTHS = np.array([[2.0, 3.1, 1.0], [0.3, 0.7, 1.0]])


@pytest.mark.slow
def test_noise_of_print_white(make_table: TableMaker) -> None:
    ((*head, level, r, g, b, high_r, high_g, high_b),) = noise_table([make_table("Test", noise=0.05, samples=400)]).rows
    assert head == ["Test", len(LIGHTS)]
    assert level == pytest.approx(100 * float(np.median(LIGHTS.max(axis=1))) / 9000, rel=0.02)
    assert (r, g, b) == pytest.approx([5] * 3, rel=0.15)
    # Of 400 samples the largest normal deviate is about three standard deviations up.
    assert (high_r, high_g, high_b) == pytest.approx([15] * 3, rel=0.4)


def test_print_of_codes_is_grey(make_table: TableMaker) -> None:
    mean, rms = printed_colours_table([make_table("Test")]).rows
    # Of the black bodies of 3002 and 3003 K the second is nearer to daylight. The codes are 0, 1/7 … 1.
    assert mean[:3] == ("Test", 3, "mean")
    assert rms[:3] == ("Test", 3, "root mean square")
    assert mean[3:] == pytest.approx([50, 50, 50, 0], abs=0.1)
    assert rms[3:6] == pytest.approx([100 * float(np.sqrt(np.mean((np.arange(8) / 7) ** 2)))] * 3, abs=0.1)


PICTURES = random_scenes(5, 24, 16, seed=8)
SIX_D, FIVE_FIFTY_D = "Canon EOS 6D Mark II", "Canon EOS 550D"


def small(make_table: TableMaker, noise: tuple[float, float] = (0.0, 0.0)) -> tuple[Block, ...]:
    luts = [make_table(SIX_D, noise[0]), make_table(FIVE_FIFTY_D, noise[1])]
    return plan_blocks(luts, PICTURES, TRUTHS, side=48, seed=3, names=("C1", "C1"))


def test_data_sets_are_in_paper_order(make_table: TableMaker) -> None:
    blocks = small(make_table)
    assert [block.key for block in blocks] == list(TABLE1)
    assert all(len(block.scenes) == 5 for block in blocks)
    images = [block.scenes[0].read()[0] for block in blocks]
    assert [image.shape for image in images] == [(32, 48, 3)] * 4 + [(48, 48, 3)] * 4
    # Nearest to the ground truths in turn, and drawn: not the same lights.
    assert [scene.light for scene in blocks[0].scenes] == [0, 3, 0, 3, 0]
    assert [scene.light for scene in blocks[1].scenes] != [scene.light for scene in blocks[0].scenes]
    # Both tables show the same scenes: what differs is the sensor.
    np.testing.assert_array_equal(blocks[4].scenes[1].source.read().picture, blocks[6].scenes[1].source.read().picture)


def test_white_pixel_is_illuminant_without_noise(make_table: TableMaker) -> None:
    random = [block for block in table1(small(make_table)) if block.key[0] == "Random"]
    assert len(random) == 4
    for block in random:
        # 2304 pixels in 512 colours hold each channel's brightest code; rounding is 1 in 1000.
        assert block.results[0].errors["recovery"].max() < 0.05
        # Uniform codes are grey on average; the mean of few is not.
        assert block.results[1].errors["recovery"].max() < 2


def test_noise_increases_error_of_white_patch_only(make_table: TableMaker) -> None:
    blocks = {block.key: block for block in table1(small(make_table, (0.02, 0.2)))}
    for scenes, lights in (("Random", "C1"), ("Random", "Random")):
        quiet, noisy = blocks[scenes, "6D", lights], blocks[scenes, "550D", lights]
        medians = [[result.summary("recovery").median for result in block.results] for block in (quiet, noisy)]
        assert medians[1][0] > 3 * medians[0][0]
        assert abs(medians[1][1] - medians[0][1]) < 1


REAL_LIGHTS = np.array([[1.0, 2, 1], [1.2, 2, 1], [1, 2, 1.3], [1.4, 2, 0.9], [1, 2, 0.8], [1.1, 2, 1.2]])
REAL = [Made(f"r{place}", light, np.ones((4, 4, 3))) for place, light in enumerate(REAL_LIGHTS)]
MADE = [Made("m", np.array([2.0, 1, 1]), np.ones((4, 4, 3)))]
FOLDS = np.array([0, 0, 1, 1, 2, 2])


def test_table2_separates_training_data() -> None:
    (trained,) = table2(REAL, MADE, {"regression-trees": MeanLearner()}, FOLDS)
    for index, light in enumerate(REAL_LIGHTS):
        generated = np.mean([unit(result) for result in REAL_LIGHTS[index // 2 != FOLDS]], axis=0)
        assert trained.real.errors["recovery"][index] == pytest.approx(float(recovery_error(generated, light)))
        assert trained.generated.errors["recovery"][index] == pytest.approx(float(recovery_error([2, 1, 1], light)))
