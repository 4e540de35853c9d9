"""The density of a real data set's lights."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from foundation.errors import FormatError
from generator import philox
from generator.lights.distributions import parse_distribution
from generator.lights.gamut import rgb_of
from generator.lights.log_kernels import LogKernels
from generator.statistics import log_chroma
from tests.generator.stats_files import write_stats


def clusters() -> npt.NDArray[np.float64]:
    """Return 200 lights in two clusters, as daylight and lamps are: (200, 3), sum 1."""
    random = np.random.default_rng(4)
    middle = np.where(np.arange(200) % 4 == 0, 1, 0)
    places = np.array([[-0.75, -0.4], [-0.3, -1.1]])[middle] + random.normal(0, 0.05, (200, 2))
    lights = np.stack([np.exp(places[:, 0]), np.ones(200), np.exp(places[:, 1])], axis=1)
    return lights / lights.sum(axis=1, keepdims=True)


def drawn(density: LogKernels, count: int = 40000) -> npt.NDArray[np.float64]:
    words = philox.words(3, np.arange(count), 0, 0, philox.CHROMATICITIES)
    return log_chroma(rgb_of(density.draw(words)))


def test_draws_have_the_lights_mean_covariance_and_clusters() -> None:
    lights = clusters()
    places, made = log_chroma(lights), drawn(LogKernels.of(lights))
    # 40 000 draws: means within 4 standard errors, variances within 4 %.
    assert made.mean(axis=0) == pytest.approx(places.mean(axis=0), abs=0.005)
    assert np.cov(made.T) == pytest.approx(np.cov(places.T, bias=True), rel=0.04)
    # Between the clusters there are no lights, and with Scott's whole factor 6 % of the draws would lie there.
    across = (made - places[1]) @ (places[0] - places[1]) / np.square(places[0] - places[1]).sum()
    assert ((across > 0.4) & (across < 0.6)).mean() < 0.02
    assert (across > 0.5).mean() == pytest.approx(0.25, abs=0.02)


def test_channel_gains_move_the_density_and_change_nothing_else() -> None:
    lights, gains = clusters(), np.array([2.0, 1.0, 0.3])
    moved = drawn(LogKernels.of(lights * gains), 100) - drawn(LogKernels.of(lights), 100)
    assert moved == pytest.approx(np.log(gains[[0, 2]])[None].repeat(100, axis=0))


def test_a_file_of_statistics_is_a_distribution(tmp_path: Path) -> None:
    path = write_stats(tmp_path / "s.json", clusters(), {})
    found = parse_distribution(str(path))
    assert isinstance(found, LogKernels)
    assert found.describe()["lights"] == 200
    assert found.describe()["file"] == "s.json"


@pytest.mark.parametrize(
    "lights", [[[1, 1, 1]], [[1, 1, 1], [1, 1, 2]], [[1, 1, 1], [1, 1, 2], [1, 1, 3]], [[0.3, 0.4, 0.3]] * 5]
)
def test_lights_without_breadth_have_no_density(lights: list[list[float]]) -> None:
    with pytest.raises(FormatError, match=r"do not lie on a line; take them as they are with --match s\.json"):
        LogKernels.of(np.array(lights, dtype=float), "s.json")
