"""What is told of the light of blocks; which frames' files state otherwise than most."""

from __future__ import annotations

from typing import Any

import pytest

from calibration.checks.frame_consistency import ForeignFrame, OriginFigures, origin_figures
from drivers.raw.rawfile import FrameOrigin


def frames(*origins: FrameOrigin) -> list[tuple[Any, FrameOrigin]]:
    return [(number, origin) for number, origin in enumerate(origins)]


def shot(shutter_s: float | None = 0.5, iso: int | None = 100, aperture: float | None = 8.0) -> FrameOrigin:
    return FrameOrigin(iso=iso, aperture=aperture, shutter_s=shutter_s)


@pytest.mark.parametrize(
    ("other", "ratio"),
    [
        (shot(0.504), None),
        (shot(0.506), 1.012),
        (shot(0.496), None),
        (shot(0.4), 0.8),
        (shot(iso=200), 2),
        (shot(aperture=5.6), (8 / 5.6) ** 2),
        # Without an f-number of its own the lens is as in the others.
        (shot(aperture=None), None),
        (shot(0.25, 400, None), 2),
        (shot(None), None),
        (shot(iso=None), None),
    ],
)
def test_frames_are_exposed_otherwise_from_a_hundredth_on(other: FrameOrigin, ratio: float | None) -> None:
    found = origin_figures(frames(shot(), other, shot())).other_exposure
    assert [one.ratio for one in found] == ([] if ratio is None else [pytest.approx(ratio)])
    if found:
        assert (found[0].found, found[0].expected) == (other.exposure_text, shot().exposure_text)


def test_a_difference_of_exposure_is_the_largest_up_or_down() -> None:
    record: Any = None
    found = tuple(ForeignFrame(record, "", "", ratio) for ratio in (1.2, 0.8, 1.1))
    assert OriginFigures(other_exposure=found).exposure_difference == pytest.approx(0.25)
    assert OriginFigures().exposure_difference == 0


def test_bodies_and_lenses_are_held_against_most_and_a_model_without_number_is_no_other() -> None:
    one, two = FrameOrigin("EOS", "1", "50 mm"), FrameOrigin("EOS", "2", "50 mm")
    found = origin_figures(frames(one, two, one, FrameOrigin("EOS M", "1", "35 mm"), FrameOrigin()))
    assert [(frame.record, frame.found, frame.expected) for frame in found.other_camera] == [
        (1, "EOS no. 2", "EOS no. 1"), (3, "EOS M no. 1", "EOS no. 1"),
    ]  # fmt: skip
    assert [(frame.record, frame.found) for frame in found.other_lens] == [(3, "35 mm")]
    unnumbered = origin_figures(frames(one, FrameOrigin("EOS"), two, FrameOrigin("EOS M", "1")))
    assert [(frame.record, frame.found, frame.expected) for frame in unnumbered.other_camera] == [
        (3, "EOS M no. 1", "EOS")
    ]
