"""What a check asks of the body: battery, card, disk, and whether it takes dark frames of its own."""

from __future__ import annotations

from pathlib import Path
from unittest.mock import Mock

import pytest

from acquisition.check.findings import Finding
from acquisition.check.supplies import judge_disk, judge_noise_reduction, judge_supplies
from drivers.camera import Supplies
from foundation.errors import LinkTimeout


def test_a_body_that_takes_dark_frames_of_its_own_is_told() -> None:
    def found(longest: float, took: float) -> Finding:
        return judge_noise_reduction([(0.5, 2.5), (longest, took), (0.5, 2.7), (0.5, 2.6), (2.0, 9.0)])

    # Beside 0.5 s, 2.1 s more; beside 4 s the same, or 4 s more than that; half of it is let pass.
    assert found(4.0, 6.1).value == pytest.approx(0.0)
    doubled = found(4.0, 10.1)
    assert (doubled.value, doubled.grade) == (pytest.approx(4.0 / 3.5), "remark")
    assert [found(4.0, 6.1 + 3.5 * share).grade for share in (0.49, 0.51)] == ["good", "remark"]
    for few in ([], [(0.1, 2.0), (0.99, 4.0)], [(0.51, 2.0), (2.0, 4.0)]):
        assert judge_noise_reduction(few).grade == "not checked"
    assert judge_noise_reduction([(0.25, 2.0), (1.0, 4.0)]).grade == "remark"


def test_the_disk_is_asked_where_the_session_will_be(tmp_path: Path) -> None:
    there = judge_disk(tmp_path / "not" / "yet", 10, 1000)
    assert there.grade == "good"
    assert str(tmp_path) in there.said
    assert judge_disk(tmp_path, 10**9, 25_000_000).grade == "fault"


@pytest.mark.parametrize(
    ("left", "frames", "battery", "card"),
    [
        (Supplies(), 767, "not checked", "good"),
        (Supplies(battery=1.0), 767, "not checked", "good"),
        (Supplies(battery=1.0, mains=False), 767, "remark", "good"),
        (Supplies(battery=0.75), 767, "remark", "good"),
        (Supplies(battery=0.25, mains=False), 767, "fault", "good"),
        (Supplies(battery=0.25, mains=True), 767, "good", "good"),
        (Supplies(saves_to_host=False), 767, "not checked", "not checked"),
        (Supplies(saves_to_host=False, card_free_bytes=10**11), 767, "not checked", "good"),
        (Supplies(saves_to_host=False, card_free_bytes=1000 * 10**6), 767, "not checked", "fault"),
        (Supplies(battery=0.75), 100, "good", "good"),
        (None, 767, "not checked", "not checked"),
    ],
)
def test_battery_and_card_are_judged_as_far_as_the_body_tells(
    left: Supplies | None, frames: int, battery: str, card: str
) -> None:
    body = Mock()
    body.supplies.side_effect = [LinkTimeout("the camera does not answer") if left is None else left]
    assert [found.grade for found in judge_supplies(body, frames, 25 * 10**6)] == [battery, card]
