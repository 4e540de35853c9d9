"""Evidence of made-up sessions: frames and positions of deviations, their appearance, and whole frames."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from calibration.causes.gathering import (
    MAX_POSITIONS,
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

# Positions of 200 cells, 20 by 10, of 10 mm; the cells themselves are 9.2 mm.
PLACES = np.stack(np.meshgrid(np.arange(20.0) * 10, np.arange(10.0) * 10), axis=-1).reshape(-1, 2)

CELL_MM = float(np.sqrt(190 * 90 / 200))


@dataclass(eq=False)
class Frame:
    """Measurements of a frame."""

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
    """Return the stains of a print whose given cells deviate, in red by half as much."""
    alone = np.zeros((200, 3))
    for cell, deviation in (off or {}).items():
        alone[cell] = (deviation / 2, deviation, deviation)
    stained = np.isin(np.arange(200), list(off or {}))
    return Stains(alone, np.full_like(alone, 1e-6), alone, stained, np.ones_like(alone), PLACES)


def session(frames: list[Frame], **more: object) -> Any:
    """Return the measurements of frames, the first of which was registered first."""

    def added_bleed(frame: Frame) -> float:
        return frame.blur_px - 0.5

    result: dict[str, Any] = {
        "frames": frames,
        "white_frames": [frame for frame in frames if frame.record.kind == "white"],
        "registered_frame": frames[0],
        "added_bleed": added_bleed,
        "cells": SimpleNamespace(stains=stains(), unfit=(), window=5),
        "dark_frames": SimpleNamespace(hottest=np.zeros(0), files=()),
        "registration": SimpleNamespace(agreement=0.97, lens_residual_px=0.6, clearance=2.0, cell_px=8.6, blur_px=0.7),
        "lens": SimpleNamespace(beyond_cell=0.01),
    }
    return SimpleNamespace(**result | more)


def numbers(gathered: Any) -> list[str]:
    """Return the numbers of the frames in evidence."""
    return [record.file.removesuffix(".dng") for record in gathered.frames]


def block(deviation: float, at: tuple[float, float] = (50.0, 40.0), extent: float = 20.0) -> FrameConsistency:
    return FrameConsistency(
        scatter=0.01, block=deviation, at_mm=at, colour=(-deviation, -deviation / 2, 0.0), share=0.1,
        extent_mm=extent, added=0.002, kept=0.9,
    )  # fmt: skip


def test_position_shows_in_frames_with_third_of_deviation() -> None:
    frames = [
        Frame("white"),
        Frame(consistency=block(0.1), blur_px=0.6, shift_px=0.2, number=1),
        Frame("white", block(0.031), number=2),
        Frame("white", block(0.029), number=3),
        Frame(consistency=block(0.05, (70.0, 40.0)), number=4),
        Frame(consistency=block(0.05, (70.1, 40.0)), number=5),
    ]
    result = block_evidence(session(frames, cells=SimpleNamespace(stains=stains({84: -0.1}))), 0.04)
    evidence = result.evidence
    # Frames 1, 2 and 4: a third of its deviation, and no further away than the place is wide.
    assert (evidence.frames, evidence.showing, evidence.even_showing, evidence.in_first) == (5, 3 / 5, 1 / 2, 0)
    # Of the cells within a radius of two cells at least, one.
    near = np.linalg.norm(PLACES - (50, 40), axis=1) < 2 * CELL_MM
    assert evidence.spot == pytest.approx(1 / near.sum())
    assert (evidence.share, evidence.deviation, evidence.tint) == pytest.approx((0.1, -0.1, 0.5))
    assert (evidence.added, evidence.kept, evidence.scatter) == (0.002, 0.9, 0.01)
    assert (evidence.softer, evidence.moved_px) == pytest.approx((0.1, 0.2))
    assert numbers(result) == ["1", "4", "5"]
    assert result.positions == (PrintPosition("1.dng", 50.0, 40.0, 20.0),)


def test_blames_first_frame_if_most_others_differ() -> None:
    others = [Frame(consistency=block(0.1 if number < 5 else 0.0), number=number) for number in range(1, 6)]
    result = block_evidence(session([Frame("white"), *others]), 0.01)
    assert (result.evidence.showing, result.evidence.in_first) == (0.8, 1)
    assert numbers(result) == ["0"]
    assert result.positions[0].file == "0.dng"
    # Blocks of less than four thousandths are none, however little the worst is.
    faint = [Frame(consistency=block(value), number=n) for n, value in enumerate((0.0, 0.005, 0.004, 0.0039))]
    assert block_evidence(session(faint), 0.01).evidence.showing == pytest.approx(2 / 3)
    assert numbers(block_evidence(session(faint), 0.01)) == ["1"], "the worst, where none is beyond the limit"


def covered(*cells: tuple[int, float]) -> FrameConsistency:
    return FrameConsistency(scatter=0.02, disturbed=cells)


def test_describes_covered_cells_by_their_frames() -> None:
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
    result = disturbed_evidence(table, 0.0)
    assert result is not None
    evidence = result.evidence
    assert (evidence.frames, evidence.showing, evidence.even_showing, evidence.in_first) == (5, 2 / 5, 1 / 3, 0)
    assert (evidence.spot, evidence.share, evidence.deviation) == pytest.approx((2 / 3, 3 / 200, -0.3))
    assert (evidence.scatter, evidence.softer) == pytest.approx((0.02, 0.2))
    assert numbers(result) == ["3", "4"]
    # Cells beside each other are one place, as wide as a disc of their area.
    sizes = [2 * np.sqrt(count / np.pi) * CELL_MM for count in (2, 1, 1)]
    assert [place.size_mm for place in result.positions] == pytest.approx(sizes)
    assert [(place.x_mm, place.y_mm) for place in result.positions] == [(45, 20), (0, 60), (70, 0)]
    assert disturbed_evidence(session(frames[:3]), 0.0) is None
    # Four of the five others show it.
    most = [Frame(), *(Frame(consistency=covered((44, -0.2)), number=n) for n in range(1, 5)), Frame(number=5)]
    result = disturbed_evidence(session(most), 0.0)
    assert result is not None
    assert result.evidence.in_first == 1
    many = [Frame(consistency=covered((44, -0.2)), number=number) for number in range(MAX_POSITIONS + 3)]
    result = disturbed_evidence(session(many), 0.0)
    assert result is not None
    assert (len(result.positions), len(result.frames)) == (12, 15)


def test_describes_spot_by_colour_and_white_frames() -> None:
    spot = dict.fromkeys((44, 45, 64, 65), -0.08)
    residual = FieldResidual((45.0, 25.0), (-0.05, -0.04, 0.0), 0.1, -0.006, 0.5)
    frames = [Frame("white"), Frame("white", left=residual, number=1),
              Frame("white", left=FieldResidual((73.0, 25.0), (-0.05, 0, 0), rim=-0.004), number=2),
              Frame("white", left=FieldResidual((45.0, 25.0), (-0.039, 0, 0)), number=3)]  # fmt: skip
    hottest = np.zeros(200)
    hottest[[44, 7]] = 9
    table = session(
        frames,
        cells=SimpleNamespace(stains=stains(spot | {7: 0.1})),
        dark_frames=SimpleNamespace(hottest=hottest, files=("d",)),
    )
    result = spot_evidence(table, 0.0)
    assert result is not None
    evidence = result.evidence
    # Off by half as much, and no further than three cells; a fourth of the corners are darker than the field.
    assert (evidence.white_residual, evidence.some_whites, evidence.rim_frames) == (1 / 4, 1, 1 / 4)
    assert (evidence.spot, evidence.share, evidence.hot) == (1, 4 / 200, 1 / 4)
    assert (evidence.deviation, evidence.tint) == pytest.approx((-0.08, 0.5))
    assert numbers(result) == ["1"]
    sizes = [2 * np.sqrt(count / np.pi) * CELL_MM for count in (4, 1)]
    assert [place.size_mm for place in result.positions] == pytest.approx(sizes)
    assert [(place.x_mm, place.y_mm) for place in result.positions] == [(45, 25), (70, 0)]
    assert {place.file for place in result.positions} == {"1.dng"}
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
def test_lists_all_frames_beyond_limit(evidence: Any, frame: dict[str, Any], limit: float, shown: list[str]) -> None:
    least: dict[str, Any] = {
        "consistency": FrameConsistency(scatter=0.04),
        "blur_px": 0.85,
        "shift_px": 0.6,
        "reregistered": True,
    }
    frames = [Frame(), Frame(number=1, **{key: least[key] for key in frame}), Frame(number=2, **frame), Frame(number=3)]
    result = evidence(session(frames), limit)
    assert numbers(result) == shown
    known, worst = result.evidence, frames[2]
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
def test_compares_exposures_with_most_light_frames(
    exposures: tuple[float, ...], ratio: float, shown: list[str]
) -> None:
    frames = [Frame(exposure=value, number=number) for number, value in enumerate(exposures)]
    frames += [Frame(exposure=0.5, number=4), Frame(exposure=0.5, number=5), Frame("white", exposure=0.5, number=6)]
    result = light_evidence(session(frames), 0.0)
    assert (result.evidence.exposure, result.evidence.frames) == pytest.approx((ratio, 7), nan_ok=True)
    assert numbers(result) == shown


def test_explains_drift_by_object_in_white_frame() -> None:
    for deviation, told in ((0.031, True), (0.03, False)):
        frames = [Frame("white"), Frame("white", block(deviation), number=1), Frame(number=2), Frame(number=3)]
        result = drift_evidence(session(frames), 0.0)
        assert numbers(result) == (["1"] if told else [])
        assert result.evidence.frames == (3 if told else 4)
        assert (result.evidence.deviation == -deviation) == told
    # What files say of exposures comes first.
    frames = [Frame("white"), Frame("white", block(0.5), number=1), *(Frame(number=n) for n in (2, 3))]
    assert numbers(drift_evidence(session([*frames, Frame(exposure=1.0, number=4)]), 0.0)) == ["4"]


def test_describes_unfit_cells_by_most_frequent_kind() -> None:
    def unfit(*kinds: str) -> Any:
        cells = [
            SimpleNamespace(kind=kind, colour=40 + number, cause=f"{kind}: x") for number, kind in enumerate(kinds)
        ]
        return SimpleNamespace(stains=stains(), unfit=cells, window=5)

    dark = SimpleNamespace(hottest=np.zeros(0), files=("dark",))
    frames = [Frame("white"), Frame(number=1)]
    result = unfit_evidence(
        session(frames, cells=unfit("lit", "hot", "uneven", "misplaced", "lit"), dark_frames=dark), 0
    )
    assert result is not None
    evidence = result.evidence
    assert (evidence.lit, evidence.hot, evidence.misplaced, evidence.uneven) == (0.4, 0.2, 0.2, 0.2)
    # Waves in pixels of cells of ten; what comes from beyond a cell, by the blur and by the lens.
    assert evidence.waves_px == pytest.approx(0.3)
    assert evidence.beyond_cell == pytest.approx(0.0132 + 0.01, abs=2e-3)
    assert [(place.x_mm, place.y_mm, place.size_mm) for place in result.positions] == [(0, 20, 0), (40, 20, 0)]
    assert unfit_evidence(session(frames, cells=unfit("stained", "lit")), 0) is None, "no spot, no evidence"
    unknown = unfit_evidence(session(frames, cells=unfit("lit")), 0)
    assert unknown is not None
    assert np.isnan(unknown.evidence.hot), "without dark frames"


def test_counts_evidence_of_files_and_dark_frames() -> None:
    frames = [Frame(number=number, light=number) for number in range(4)]
    foreign = tuple(
        SimpleNamespace(found=result, record=frames[n].record) for n, result in ((1, "B"), (2, "B"), (3, "C"))
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
    result = stray_evidence(table, 0.01)
    assert (result.evidence.stray, result.evidence.stray_primaries, numbers(result)) == (0.03, 0.004, ["2"])
