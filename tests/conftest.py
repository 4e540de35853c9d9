"""Which tests are slow: what is left out of `make quick`, so that it takes less than a minute on two cores."""

from __future__ import annotations

from pathlib import Path

import pytest

TESTS = Path(__file__).parent
SLOW = (
    "acquisition/test_annotated.py",
    "acquisition/test_chart_command.py",
    "acquisition/test_field.py",
    "acquisition/test_framing.py",
    "acquisition/test_layout.py",
    "acquisition/test_marks.py",
    "acquisition/test_movement.py",
    "acquisition/test_printing.py",
    "acquisition/test_proof.py",
    "acquisition/test_visibility.py",
    "calibration/test_build.py",
    "calibration/test_cell_field.py",
    "calibration/test_growing.py",
    "calibration/test_labels.py",
    "calibration/test_linearity.py",
    "calibration/test_plain_chart.py",
    "calibration/test_plain_session.py",
    "calibration/test_registration.py",
    "calibration/test_small_charts.py",
    "calibration/test_stains.py",
    "calibration/test_subtraction.py",
    "calibration/test_verdict.py",
    "calibration/test_windows.py",
    "drivers/ptp/test_ptp_malformed.py",
    "drivers/test_fullscreen.py",
    "drivers/test_gphoto2_camera.py",
    "drivers/test_rawfile.py",
    "end_to_end",
    "foundation/test_compiled.py",
    "generator/test_choices.py",
    "generator/test_dataset.py",
    "generator/test_engines.py",
    "generator/test_generate_command.py",
    "generator/test_layouts.py",
    "generator/test_library.py",
    "generator/test_patches.py",
    "generator/test_resuming.py",
    "house/test_commands.py",
    "house/test_contributing.py",
    "sim/test_dng.py",
    "sim/test_geometry.py",
    "sim/test_world.py",
)
"""Folders and files, below this one, whose tests take more than their share of the minute."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests of slow files and folders."""
    missing = [name for name in SLOW if not (TESTS / name).exists()]
    if missing:
        raise pytest.UsageError(f"{__file__}: SLOW names {', '.join(missing)}, which are not there; correct the list")
    slow = [TESTS / name for name in SLOW]
    for item in items:
        if any(item.path == place or place in item.path.parents for place in slow):
            item.add_marker(pytest.mark.slow)
