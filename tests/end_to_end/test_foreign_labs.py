"""Faults of lenses and laboratories are noticed: small `benchmarks.cases`, and the comparison with the truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.cases import BY_NAME, CASES, FAILURES, chart_of, try_case
from benchmarks.sessions import (
    AS_PLANNED,
    EIGHT_LIGHTS,
    FrameChange,
    compare,
    expected_counts,
    frame_file,
    short_plan,
    short_session,
    world_of,
)
from calibration.pipeline.build import build
from calibration.table.lut import open_lut
from drivers.raw.rawfile import read_raw
from experiment.session.records import SessionStep, plan_steps
from sim.world.sensors import BODIES
from sim.world.world import Blob, Glare, Room, Situation, World

pytestmark = pytest.mark.slow

# Cases with a stricter test of the same size elsewhere; `benchmarks.rooms --case all` runs all cases.
TESTED_ELSEWHERE = {
    # tests/calibration/pipeline/test_held_against_itself.py
    "other-camera", "red-blue", "warm-cool", "white-red", "white-reference-red", "half-exposed", "half-exposed-whites",
    "red-missing", "other-iso",
    # tests/calibration/causes/test_sessions.py, and a fainter one of these
    "hand-in-white", "hand-in-light", "shadow-on-primary", "broad-glare", "mild-glare", "stain", "defocus",
    "hot-photosite",
    # tests/calibration/pipeline/test_plain_session.py; test_trust.py here
    "bump", "other-print",
    # Here, with a primary in place of a dim light
    "mixed-dim",
    # tests/calibration/pipeline/test_stray_light.py
    "leak",
    # tests/calibration/pipeline/test_held_against_itself.py, test_print_and_sensor.py; tests/calibration/registration
    "nothing-wrong", "hot-photosites", "upside-down",
    # tests/calibration/causes/test_sessions.py, test_print_and_sensor.py
    "fall-off",
    # Here, both at once, and in tests/calibration/spread/test_spread.py
    "mild-shoulders", "strong-shoulders", "veil",
}  # fmt: skip


@pytest.fixture(scope="module")
def world() -> World:
    return world_of(chart_of(small=True), BODIES["Test"], Room(seed=1))


def test_comparison_subtracts_noise_and_finds_errors(world: World, tmp_path: Path) -> None:
    """Samples of a few patches are raised by 5 %; the comparison finds these errors and almost no others."""
    chart = chart_of(small=True)
    with short_session(tmp_path / "session", chart, world) as session:
        result = build(session, tmp_path / "lut")
        table = open_lut(tmp_path / "lut")
        clean = compare(result, table, world, chart, session)
        raised = np.asarray(table.samples).copy()
        raised[3, 10:14] = np.rint(raised[3, 10:14] * 1.05).astype(raised.dtype)
        raised_errors = compare(result, replace(table, samples=raised), world, chart, session)
    # A mean of 25 samples has noise of 0.3 % and more.
    assert clean.rms < 0.002
    assert clean.worst < 0.02
    assert clean.light_deg.max() < 0.1
    added = (raised_errors.error - clean.error)[3, 10:14]
    lit = clean.lit[3, 10:14]
    assert lit.any()
    np.testing.assert_allclose(added[lit], 0.05, atol=0.004)
    assert raised_errors.cells_beyond(0.03) == int(lit.any(axis=1).sum())


@pytest.mark.parametrize(
    "change",
    [
        AS_PLANNED,
        FrameChange(situation=Situation(blobs=(Blob((0.2, 0.2, 0.6, 0.8)),))),
        FrameChange(situation=Situation(glares=(Glare((0, 0, 1, 1), 0.05),), ambient=(0.01, 0.0, 0.02))),
        FrameChange(counts_added={(200, 300): 4000}),
    ],
    ids=["as planned", "hand", "glare", "hot"],
)
def test_expected_counts_equal_frame_without_noise(change: FrameChange, world: World, tmp_path: Path) -> None:
    """The standardised difference has a variance of 1 and no value beyond 7 (photon transfer, EMVA 1288)."""
    step = SessionStep(3, "light", 0, BY_NAME["veil"].lights["warm"])
    (tmp_path / "frame.dng").write_bytes(frame_file(world, step, change))
    area, body = world.body.visible, world.body
    counts = read_raw(tmp_path / "frame.dng").sensor[area.top : area.top + area.height, area.left :][:, : area.width]
    expected = expected_counts(world, step, change).astype(np.float64)
    spread = np.sqrt(expected / body.gain_e(100) + body.noise_dn(100) ** 2 + 1 / 12)
    standardised = (counts - float(body.black) - expected) / spread
    if change.counts_added:
        standardised = np.delete(standardised.ravel(), (200 - area.top) * area.width + 300 - area.left)
    assert abs(float(standardised.mean())) < 0.01
    assert float(standardised.var()) == pytest.approx(1, abs=0.02)
    assert float(np.abs(standardised).max()) < 7


def test_every_case_changes_the_room_the_plan_or_a_frame(world: World) -> None:
    assert BY_NAME.keys() >= TESTED_ELSEWHERE
    for case in CASES:
        lights = short_plan(case.lights)
        changes = case.changes(world, chart_of(small=True), lights)
        changed = any(changes(step) != AS_PLANNED for step in plan_steps(lights, case.every))
        assert changed or case.room or len(lights) < len(EIGHT_LIGHTS), case.name


@pytest.mark.parametrize("name", [name for name in BY_NAME if name not in TESTED_ELSEWHERE])
def test_case_is_refused_or_named_or_right(name: str) -> None:
    row = try_case(BY_NAME[name], small=True)
    assert not [failure for failure in FAILURES if row[failure]], row["says"]
