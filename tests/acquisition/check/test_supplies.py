"""Checks of battery, card, disk and the camera's own dark frames."""

from __future__ import annotations

from pathlib import Path
from unittest.mock import Mock

import pytest

from acquisition.check.findings import Finding
from acquisition.check.supplies import judge_disk, judge_noise_reduction, judge_supplies
from drivers.camera import Supplies
from foundation.errors import LinkTimeout


def test_reports_noise_reduction_of_camera() -> None:
    def finding(longest: float, took: float) -> Finding:
        return judge_noise_reduction([(0.5, 2.5), (longest, took), (0.5, 2.7), (0.5, 2.6), (2.0, 9.0)])

    # 2.1 s more than 0.5 s; 4 s takes the same, or 4 s more than that; up to half of it is accepted.
    assert finding(4.0, 6.1).value == pytest.approx(0.0)
    doubled = finding(4.0, 10.1)
    assert (doubled.value, doubled.grade) == (pytest.approx(4.0 / 3.5), "remark")
    assert [finding(4.0, 6.1 + 3.5 * share).grade for share in (0.49, 0.51)] == ["good", "remark"]
    for timings in ([], [(0.1, 2.0), (0.99, 4.0)], [(0.51, 2.0), (2.0, 4.0)]):
        assert judge_noise_reduction(timings).grade == "not checked"
    assert judge_noise_reduction([(0.25, 2.0), (1.0, 4.0)]).grade == "remark"


def test_judges_disk_of_session_folder(tmp_path: Path) -> None:
    finding = judge_disk(tmp_path / "not" / "yet", 10, 1000)
    assert finding.grade == "good"
    assert str(tmp_path) in finding.said
    assert judge_disk(tmp_path, 10**9, 25_000_000).grade == "fault"


@pytest.mark.parametrize(
    ("supplies", "frames", "battery", "card"),
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
def test_judges_battery_and_card(supplies: Supplies | None, frames: int, battery: str, card: str) -> None:
    body = Mock()
    body.supplies.side_effect = [LinkTimeout("the camera does not answer") if supplies is None else supplies]
    assert [finding.grade for finding in judge_supplies(body, frames, 25 * 10**6)] == [battery, card]
