"""What is gathered of a made-up session: in which frames a place shows, how it looks, and what of frames as a whole."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from calibration.causes.gathering import (
    MAX_PLACES,
    PrintPosition,
    block_evidence,
    blur_evidence,
    brightness_evidence,
    camera_evidence,
    dark_evidence,
    disturbed_evidence,
    drift_evidence,
    iso_evidence,
    light_evidence,
    movement_evidence,
    scatter_evidence,
    spot_evidence,
    stray_evidence,
    unfit_evidence,
)
from calibration.checks.frame_consistency import FrameConsistency
from experiment.measures.paper import FieldResidual
from experiment.measures.stains import Stains

PLACES = np.stack(np.meshgrid(np.arange(20.0) * 10, np.arange(10.0) * 10), axis=-1).reshape(-1, 2)
"""Of 200 cells, 20 by 10, of 10 mm; those that a square stands for have 9.2 mm."""

CELL_MM = float(np.sqrt(190 * 90 / 200))


@dataclass(eq=False)
class Frame:
    """What is measured of a frame."""

    kind: str = "light"
    consistency: FrameConsistency = field(default_factory=FrameConsistency)
    left: FieldResidual = field(default_factory=FieldResidual)
    blur_px: float = 0.5
    exposure: float = 0.5
    reregistered: bool = False
    shift_px: float = 0.0
    number: int = 0
    white: tuple[float, float, float] = (4.0, 9.0, 2.0)
    light: int | None = None
    paper: Any = field(init=False)
    record: Any = field(init=False)
    shift: Any = field(init=False)

    def __post_init__(self) -> None:
        self.paper = SimpleNamespace(left=self.left, white=np.array(self.white), spread=np.ones(3))
        self.record = SimpleNamespace(kind=self.kind, file=f"{self.number}.dng", illumination=self.light)
        self.shift = SimpleNamespace(length_px=self.shift_px)


def stains(off: dict[int, float] | None = None) -> Stains:
    """Return a print that is clean but for cells that are off by so much, in red half of it."""
    alone = np.zeros((200, 3))
    for cell, deviation in (off or {}).items():
        alone[cell] = (deviation / 2, deviation, deviation)
    stained = np.isin(np.arange(200), list(off or {}))
    return Stains(alone, np.full_like(alone, 1e-6), alone, stained, np.ones_like(alone), PLACES)


def session(frames: list[Frame], **more: object) -> Any:
    """Return a table of frames, of which the first was registered first."""

    def added_bleed(frame: Frame) -> float:
        return frame.blur_px - 0.5

    found: dict[str, Any] = {
        "frames": frames,
        "white_frames": [frame for frame in frames if frame.record.kind == "white"],
        "registered_frame": frames[0],
        "added_bleed": added_bleed,
        "cells": SimpleNamespace(stains=stains(), unfit=(), window=5),
        "dark_frames": SimpleNamespace(hottest=np.zeros(0), files=()),
        "registration": SimpleNamespace(agreement=0.97, lens_residual_px=0.6, clearance=2.0, cell_px=8.6, blur_px=0.7),
        "lens": SimpleNamespace(beyond_cell=0.01),
    }
    return SimpleNamespace(**found | more)


def numbers(gathered: Any) -> list[str]:
    """Return the numbers of the frames that show it."""
    return [record.file.removesuffix(".dng") for record in gathered.frames]


def block(deviation: float, at: tuple[float, float] = (50.0, 40.0), extent: float = 20.0) -> FrameConsistency:
    return FrameConsistency(
        scatter=0.01, block=deviation, at_mm=at, colour=(-deviation, -deviation / 2, 0.0), share=0.1,
        extent_mm=extent, added=0.002, kept=0.9,
    )  # fmt: skip


def test_a_place_shows_in_the_frames_that_differ_there_by_a_third_as_much() -> None:
    frames = [
        Frame("white"),
        Frame(consistency=block(0.1), blur_px=0.6, shift_px=0.2, number=1),
        Frame("white", block(0.031), number=2),
        Frame("white", block(0.029), number=3),
        Frame(consistency=block(0.05, (70.0, 40.0)), number=4),
        Frame(consistency=block(0.05, (70.1, 40.0)), number=5),
    ]
    found = block_evidence(session(frames, cells=SimpleNamespace(stains=stains({84: -0.1}))), 0.04)
    known = found.evidence
    # Frames 1, 2 and 4: a third of its deviation, and no further away than the place is wide.
    assert (known.frames, known.showing, known.even_showing, known.in_first) == (5, 3 / 5, 1 / 2, 0)
    # Of the cells within a radius of two cells at least, one.
    near = np.linalg.norm(PLACES - (50, 40), axis=1) < 2 * CELL_MM
    assert known.spot == pytest.approx(1 / near.sum())
    assert (known.share, known.deviation, known.tint) == pytest.approx((0.1, -0.1, 0.5))
    assert (known.added, known.kept, known.scatter) == (0.002, 0.9, 0.01)
    assert (known.softer, known.moved_px) == pytest.approx((0.1, 0.2))
    assert numbers(found) == ["1", "4", "5"]
    assert found.positions == (PrintPosition("1.dng", 50.0, 40.0, 20.0),)


def test_what_four_of_five_frames_show_lies_on_the_first() -> None:
    others = [Frame(consistency=block(0.1 if number < 5 else 0.0), number=number) for number in range(1, 6)]
    found = block_evidence(session([Frame("white"), *others]), 0.01)
    assert (found.evidence.showing, found.evidence.in_first) == (0.8, 1)
    assert numbers(found) == ["0"]
    assert found.positions[0].file == "0.dng"
    # Blocks of less than four thousandths are none, however little the worst is.
    faint = [Frame(consistency=block(value), number=n) for n, value in enumerate((0.0, 0.005, 0.004, 0.0039))]
    assert block_evidence(session(faint), 0.01).evidence.showing == pytest.approx(2 / 3)
    assert numbers(block_evidence(session(faint), 0.01)) == ["1"], "the worst, where none is beyond the limit"


def covered(*cells: tuple[int, float]) -> FrameConsistency:
    return FrameConsistency(scatter=0.02, disturbed=cells)


def test_few_covered_cells_are_told_by_the_frames_in_which_they_are() -> None:
    cells = ((44, -0.2), (45, -0.3), (120, -0.25))
    frames = [
        Frame("white"),
        Frame("white", covered((44, -0.2)), number=1),
        Frame("white", number=2),
        Frame(consistency=covered(*cells), number=3, blur_px=0.7),
        Frame(consistency=covered((7, -0.4)), number=4),
        Frame("white", number=5),
    ]
    table = session(frames, cells=SimpleNamespace(stains=stains({44: -0.1, 120: 0.1})))
    found = disturbed_evidence(table, 0.0)
    assert found is not None
    known = found.evidence
    assert (known.frames, known.showing, known.even_showing, known.in_first) == (5, 2 / 5, 1 / 3, 0)
    assert (known.spot, known.share, known.deviation) == pytest.approx((2 / 3, 3 / 200, -0.3))
    assert (known.scatter, known.softer) == pytest.approx((0.02, 0.2))
    assert numbers(found) == ["3", "4"]
    # Cells beside each other are one place, as wide as a disc of their area.
    sizes = [2 * np.sqrt(count / np.pi) * CELL_MM for count in (2, 1, 1)]
    assert [place.size_mm for place in found.positions] == pytest.approx(sizes)
    assert [(place.x_mm, place.y_mm) for place in found.positions] == [(45, 20), (0, 60), (70, 0)]
    assert disturbed_evidence(session(frames[:3]), 0.0) is None
    # Four of the five others show it.
    most = [Frame(), *(Frame(consistency=covered((44, -0.2)), number=n) for n in range(1, 5)), Frame(number=5)]
    found = disturbed_evidence(session(most), 0.0)
    assert found is not None
    assert found.evidence.in_first == 1
    many = [Frame(consistency=covered((44, -0.2)), number=number) for number in range(MAX_PLACES + 3)]
    found = disturbed_evidence(session(many), 0.0)
    assert found is not None
    assert (len(found.positions), len(found.frames)) == (12, 15)


def test_a_spot_is_told_by_its_colour_and_by_the_white_frames_whose_references_show_it() -> None:
    spot = dict.fromkeys((44, 45, 64, 65), -0.08)
    off = FieldResidual((45.0, 25.0), (-0.05, -0.04, 0.0), 0.1, -0.006, 0.5)
    frames = [Frame("white"), Frame("white", left=off, number=1),
              Frame("white", left=FieldResidual((73.0, 25.0), (-0.05, 0, 0), rim=-0.004), number=2),
              Frame("white", left=FieldResidual((45.0, 25.0), (-0.039, 0, 0)), number=3)]  # fmt: skip
    hottest = np.zeros(200)
    hottest[[44, 7]] = 9
    table = session(
        frames,
        cells=SimpleNamespace(stains=stains(spot | {7: 0.1})),
        dark_frames=SimpleNamespace(hottest=hottest, files=("d",)),
    )
    found = spot_evidence(table, 0.0)
    assert found is not None
    known = found.evidence
    # Off by half as much, and no further than three cells; a fourth of the corners are darker than the field.
    assert (known.white_residual, known.some_whites, known.rim_frames) == (1 / 4, 1, 1 / 4)
    assert (known.spot, known.share, known.hot) == (1, 4 / 200, 1 / 4)
    assert (known.deviation, known.tint) == pytest.approx((-0.08, 0.5))
    assert numbers(found) == ["1"]
    sizes = [2 * np.sqrt(count / np.pi) * CELL_MM for count in (4, 1)]
    assert [place.size_mm for place in found.positions] == pytest.approx(sizes)
    assert [(place.x_mm, place.y_mm) for place in found.positions] == [(45, 25), (70, 0)]
    assert {place.file for place in found.positions} == {"1.dng"}
    assert spot_evidence(session(frames), 0.0) is None


@pytest.mark.parametrize(
    ("evidence", "frame", "limit", "shown"),
    [
        (scatter_evidence, {"consistency": FrameConsistency(scatter=0.05)}, 0.03, ["2", "1"]),
        (scatter_evidence, {"consistency": FrameConsistency(scatter=0.05)}, 0.05, []),
        (blur_evidence, {"blur_px": 0.9}, 0.3, ["2", "1"]),
        (movement_evidence, {"shift_px": 0.7, "reregistered": True}, 0.0, ["2", "1"]),
    ],
)
def test_a_frame_as_a_whole_is_told_with_those_beyond_the_limit(
    evidence: Any, frame: dict[str, Any], limit: float, shown: list[str]
) -> None:
    least: dict[str, Any] = {
        "consistency": FrameConsistency(scatter=0.04),
        "blur_px": 0.85,
        "shift_px": 0.6,
        "reregistered": True,
    }
    frames = [Frame(), Frame(number=1, **{key: least[key] for key in frame}), Frame(number=2, **frame), Frame(number=3)]
    found = evidence(session(frames), limit)
    assert numbers(found) == shown
    known, worst = found.evidence, frames[2]
    assert (known.frames, known.showing, known.agreement) == (4, len(shown) / 4, 0.97)
    assert (known.scatter, known.moved_px) == (worst.consistency.scatter, worst.shift_px)
    assert known.softer == pytest.approx(worst.blur_px - 0.5)
    assert known.anew == (0.5 if "reregistered" in frame else 0)
    # Where all show it, it is none of single frames.
    everywhere = evidence(session([Frame(number=n, **frame) for n in range(3)]), 0.0)
    assert (everywhere.frames, everywhere.evidence.showing) == ((), 1)


@pytest.mark.parametrize(
    ("exposures", "ratio", "shown"),
    [
        ((0.5, 0.5, 0.5, 0.5), 1, []),
        ((0.5, 0.5, 0.515, 0.5), 1.03, []),
        ((0.5, 0.5, 0.516, 0.5), 1.032, ["2"]),
        # In powers of two: half as far as the worst, and one that is not.
        ((0.5, 0.125, 0.5, 0.25), 1 / 4, ["1"]),
        ((0.5, 0.125, 0.5, 0.24), 1 / 4, ["1", "3"]),
        ((0.5, 0.0, 0.5, 0.5), np.nan, []),
    ],
)
def test_exposures_are_held_against_that_of_most_light_frames(
    exposures: tuple[float, ...], ratio: float, shown: list[str]
) -> None:
    frames = [Frame(exposure=value, number=number) for number, value in enumerate(exposures)]
    frames += [Frame(exposure=0.5, number=4), Frame(exposure=0.5, number=5), Frame("white", exposure=0.5, number=6)]
    found = light_evidence(session(frames), 0.0)
    assert (found.evidence.exposure, found.evidence.frames) == pytest.approx((ratio, 7), nan_ok=True)
    assert numbers(found) == shown


def test_a_drift_is_told_by_what_lies_on_the_print_in_a_white_frame() -> None:
    for deviation, told in ((0.031, True), (0.03, False)):
        frames = [Frame("white"), Frame("white", block(deviation), number=1), Frame(number=2), Frame(number=3)]
        found = drift_evidence(session(frames), 0.0)
        assert numbers(found) == (["1"] if told else [])
        assert found.evidence.frames == (3 if told else 4)
        assert (found.evidence.deviation == -deviation) == told
    # What files say of exposures comes first.
    frames = [Frame("white"), Frame("white", block(0.5), number=1), *(Frame(number=n) for n in (2, 3))]
    assert numbers(drift_evidence(session([*frames, Frame(exposure=1.0, number=4)]), 0.0)) == ["4"]


def test_unfit_cells_are_told_by_what_most_of_them_are() -> None:
    def unfit(*kinds: str) -> Any:
        cells = [
            SimpleNamespace(kind=kind, colour=40 + number, cause=f"{kind}: x") for number, kind in enumerate(kinds)
        ]
        return SimpleNamespace(stains=stains(), unfit=cells, window=5)

    dark = SimpleNamespace(hottest=np.zeros(0), files=("dark",))
    frames = [Frame("white"), Frame(number=1)]
    found = unfit_evidence(
        session(frames, cells=unfit("lit", "hot", "uneven", "misplaced", "lit"), dark_frames=dark), 0
    )
    assert found is not None
    known = found.evidence
    assert (known.lit, known.hot, known.misplaced, known.uneven) == (0.4, 0.2, 0.2, 0.2)
    # Waves in pixels of cells of ten; what comes from beyond a cell, by the blur and by the lens.
    assert known.waves_px == pytest.approx(0.3)
    assert known.beyond_cell == pytest.approx(0.0132 + 0.01, abs=2e-3)
    assert [(place.x_mm, place.y_mm, place.size_mm) for place in found.positions] == [(0, 20, 0), (40, 20, 0)]
    assert unfit_evidence(session(frames, cells=unfit("stained", "lit")), 0) is None, "no spot, no evidence"
    unknown = unfit_evidence(session(frames, cells=unfit("lit")), 0)
    assert unknown is not None
    assert np.isnan(unknown.evidence.hot), "without dark frames"


def test_what_files_and_dark_frames_say_is_counted() -> None:
    frames = [Frame(number=number, light=number) for number in range(4)]
    foreign = tuple(
        SimpleNamespace(found=found, record=frames[n].record) for n, found in ((1, "B"), (2, "B"), (3, "C"))
    )
    origins = SimpleNamespace(other_camera=foreign, other_lens=(), other_iso=foreign[:2])
    codes = SimpleNamespace(off_brightness=np.array([0.05, 0.0, 0.06, 0.04]))
    stray = SimpleNamespace(
        lights_beyond=lambda limit: [2, 9] if limit == 0.01 else [],  # pyrefly: ignore[implicit-any-lambda]
        certain=np.array([0.0, 0.02, 0.03]),
        of_primaries=0.004,
    )
    table = session(
        frames, origins=origins, dark_share=0.02, dark_change=0.001,
        dark_frames=SimpleNamespace(files=("a", "b"), hottest=np.zeros(0)),
        lights=SimpleNamespace(codes=codes, stray=stray, additivity=None),
    )  # fmt: skip
    camera, iso, dark = camera_evidence(table, 0), iso_evidence(table, 0), dark_evidence(table, 0)
    assert (camera.evidence.cameras, camera.evidence.frames, numbers(camera)) == (3, 4, ["1", "2", "3"])
    assert (iso.evidence.other_iso, iso.evidence.frames, numbers(iso)) == (2, 4, ["1", "2"])
    assert (dark.evidence.frames, dark.evidence.room, dark.evidence.room_change) == (2, 0.02, 0.001)
    assert numbers(brightness_evidence(table, 0.05)) == ["2"]
    found = stray_evidence(table, 0.01)
    assert (found.evidence.stray, found.evidence.stray_primaries, numbers(found)) == (0.03, 0.004, ["2"])
