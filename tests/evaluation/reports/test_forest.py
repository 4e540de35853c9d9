"""Forest plots: every ratio where it belongs, what is not known nowhere, and a wide interval squeezes no other."""

from __future__ import annotations

import re
from math import inf, nan

import pytest

from evaluation.experiments.transfer.outcome import Figure, ForestLine, forest_plot, round_numbers

PANELS = ("Med.", "Mean")


def markers(svg: bytes) -> list[tuple[float, float]]:
    """Return where markers stand: x, y in points from the top left."""
    uses = re.findall(r'<use xlink:href="#\w+" x="([\d.]+)" y="([\d.]+)" style="fill: #', svg.decode())
    return [(float(x), float(y)) for x, y in uses]


def line(label: str, *ratios: tuple[float, float, float], whole: bool = True) -> ForestLine:
    return ForestLine(label, tuple(Figure(*ratio) for ratio in ratios), whole=whole)


def test_ratios_stand_on_a_logarithmic_axis_from_top_to_bottom() -> None:
    lines = [
        line("half", (0.5, 0.4, 0.6), (1, 0.9, 1.1)),
        line("one", (1, 0.9, 1.1), (2, 1.9, 2.2), whole=False),
        line("two", (2, 1.8, 2.5), (0.5, 0.4, 0.6)),
    ]
    first, second = markers(forest_plot(lines, PANELS))[:3], markers(forest_plot(lines, PANELS))[3:]
    assert len(first) == len(second) == 3
    (half, one, two), ys = zip(*first, strict=True)
    assert one - half == pytest.approx(two - one, abs=0.01) != 0
    assert half < one < two
    assert ys == tuple(sorted(ys))
    # The panels share their scale.
    assert second[1][0] - second[0][0] == pytest.approx(two - one, abs=0.01)


def test_what_is_not_known_is_not_drawn() -> None:
    known = line("known", (1.2, 1, 1.4), (0.9, nan, nan))
    unknown = line("unknown", (nan, nan, nan), (inf, nan, nan))
    assert len(markers(forest_plot([ForestLine("Method"), known, unknown], PANELS))) == 2
    assert not markers(forest_plot([ForestLine("Method"), unknown], PANELS))


def test_a_wide_interval_does_not_squeeze_the_others() -> None:
    def distance(end: float) -> float:
        lines = [line("a", (1.0, 0.9, end), (1, 1, 1)), line("b", (1.2, 1.1, 1.3), (1, 1, 1))]
        (a, b), _ = zip(*markers(forest_plot(lines, PANELS))[:2], strict=True)
        return b - a

    assert distance(1000) > 0.1 * distance(1.3)
    assert distance(1000) == distance(10000)


def test_names_stand_as_they_are() -> None:
    svg = forest_plot([ForestLine("Trees <$x_1$>"), line("_mine", (1, 1, 1), (1, 1, 1))], PANELS).decode()
    for text in ("Trees &lt;$x_1$&gt;", "_mine", *PANELS):
        assert f">{text}</text>" in svg


@pytest.mark.parametrize(("low", "high"), [(0.79, 1.26), (0.2, 1.3), (0.5, 40), (0.01, 900)])
def test_numbers_of_an_axis_are_few_and_within_it(low: float, high: float) -> None:
    numbers = round_numbers(low, high)
    assert 1 in numbers
    assert numbers == sorted(numbers)
    assert 3 <= len(numbers) <= 7
    assert low <= numbers[0] < numbers[-1] <= high
