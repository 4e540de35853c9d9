"""Which tests are slow: what is left out of `make quick`, so that it takes less than a minute on two cores."""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path

import pytest
from hypothesis import settings

# Test processes share the machine. Threads that libraries start in each of them spin while they wait for one another:
# without this a system of a hundred equations takes OpenBLAS fifty times as long, and a build twice. Must stand before
# NumPy is imported; what tests start inherits it. Threads of our own are as many as ever.
for _threads in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
    os.environ.setdefault(_threads, "1")

# Sessions and tables are written to the disk for good, step by step: a run of twenty lights waits for it half a second.
# What is lost with the power is of no interest here, and in memory nobody waits.
MEMORY = Path("/dev/shm")
MEMORY_BYTES = 4 << 30
"""Free space from which temporary folders lie in memory: what is there at a time of a whole run is below a gigabyte,
since the folders of tests that pass are removed at once."""

if MEMORY.is_dir() and os.access(MEMORY, os.W_OK) and shutil.disk_usage(MEMORY).free > MEMORY_BYTES:
    os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", str(MEMORY))

# PyTorch loads Triton's LLVM where that is installed, which crashes a process in which Mesa has loaded its own for
# OpenGL. No program shows a full screen and trains; a test process may do both. None keeps a module from
# being imported.
sys.modules.setdefault("triton", None)  # pyright: ignore[reportArgumentType]

TESTS = Path(__file__).parent
SLOW = (
    "acquisition/chart/test_layout.py",
    "acquisition/chart/test_margins.py",
    "acquisition/chart/test_model.py",
    "acquisition/chart/test_printing.py",
    "acquisition/chart/test_proof.py",
    "acquisition/check/test_foretelling.py",
    "acquisition/check/test_rooms.py",
    "acquisition/framing/test_annotated.py",
    "acquisition/framing/test_finding.py",
    "acquisition/framing/test_tagless_field.py",
    "acquisition/framing/test_visibility.py",
    "acquisition/monitor/test_page.py",
    "acquisition/run/test_planning.py",
    "acquisition/session/test_disk_faults.py",
    "acquisition/session/test_journal_file.py",
    "acquisition/session/test_journal_model.py",
    "acquisition/session/test_states.py",
    "acquisition/test_chart_command.py",
    "calibration/causes/test_sessions.py",
    "calibration/checks/test_frame_consistency.py",
    "calibration/checks/test_light_codes.py",
    "calibration/checks/test_stains.py",
    "calibration/comparison/test_compared_sessions.py",
    "calibration/pipeline/test_build.py",
    "calibration/pipeline/test_checkpoint.py",
    "calibration/pipeline/test_drift_correction.py",
    "calibration/pipeline/test_held_against_itself.py",
    "calibration/pipeline/test_stray_light.py",
    "calibration/pipeline/test_linearity.py",
    "calibration/pipeline/test_options.py",
    "calibration/pipeline/test_plain_session.py",
    "calibration/pipeline/test_prefetching.py",
    "calibration/pipeline/test_print_and_sensor.py",
    "calibration/pipeline/test_refused_table.py",
    "calibration/pipeline/test_retaking.py",
    "calibration/pipeline/test_small_charts.py",
    "calibration/radiometry/test_cell_field.py",
    "calibration/radiometry/test_dark_subtraction.py",
    "acquisition/framing/test_movement.py",
    "acquisition/judge/test_judge.py",
    "calibration/registration/test_register.py",
    "calibration/registration/test_register_without_tags.py",
    "calibration/report/test_places.py",
    "calibration/sampling/test_windows.py",
    "calibration/spread/test_spread.py",
    "drivers/display/test_fullscreen.py",
    "drivers/ptp/test_malformed.py",
    "drivers/raw/test_rawfile.py",
    "drivers/gphoto2_camera/test_camera.py",
    "end_to_end",
    "evaluation/commands/test_choosing.py",
    "evaluation/commands/test_compare.py",
    "evaluation/commands/test_describe.py",
    "evaluation/commands/test_learning_commands.py",
    "evaluation/commands/test_paper.py",
    "evaluation/commands/test_transfer.py",
    "evaluation/datasets/published/test_cube_plus.py",
    "evaluation/datasets/published/test_cube_plus_plus.py",
    "evaluation/datasets/published/test_mat5.py",
    "evaluation/datasets/test_damage.py",
    "evaluation/datasets/test_generated.py",
    "evaluation/datasets/test_layouts.py",
    "evaluation/experiments/describing/test_against.py",
    "evaluation/experiments/describing/test_description.py",
    "evaluation/experiments/test_bootstrap.py",
    "evaluation/experiments/test_cross_validation.py",
    "evaluation/experiments/test_run_folder.py",
    "evaluation/experiments/test_tuning.py",
    "evaluation/learning/test_learners.py",
    "evaluation/learning/test_log_chroma.py",
    "evaluation/methods/test_gray_edge.py",
    "evaluation/results/test_method_records.py",
    "evaluation/test_cli.py",
    "foundation/test_compiled.py",
    "foundation/test_disk_faults.py",
    "generator/dataset/production/test_engines.py",
    "generator/dataset/production/test_layouts.py",
    "generator/dataset/production/test_workplace.py",
    "generator/dataset/test_contact_sheet.py",
    "generator/dataset/test_making.py",
    "generator/dataset/test_reader.py",
    "generator/dataset/test_rendered_datasets.py",
    "generator/dataset/test_stores.py",
    "generator/dataset/test_varied_datasets.py",
    "generator/kernels/test_choice_statistics.py",
    "generator/kernels/test_dithering.py",
    "generator/kernels/test_patches.py",
    "generator/lights/test_mixture_realism.py",
    "generator/likeness/test_like.py",
    "generator/likeness/test_same_lights.py",
    "generator/rendering/test_colorimetric.py",
    "generator/test_cli.py",
    "generator/test_library.py",
    "generator/test_rendering_told.py",
    "generator/training/test_crops.py",
    "house/test_commands.py",
    "house/test_contributing.py",
    "sim/camera/test_dng.py",
    "sim/world/test_geometry.py",
    "sim/world/test_profile.py",
    "sim/world/test_world.py",
    "synthesis/test_spectral_table.py",
    "synthesis/test_table.py",
)
"""Folders and files, below this one, whose tests take more than their share of the minute."""


QUICK_EXAMPLES = 20
"""Examples of each property in `make quick`: a fifth of what `make test` tries, since
the properties took a third of the minute."""

settings.register_profile("quick", max_examples=QUICK_EXAMPLES)


def pytest_configure(config: pytest.Config) -> None:
    """Refuse a list that names what is not there; try fewer examples where slow tests are not wanted."""
    if config.getoption("markexpr") == "not slow":
        settings.load_profile("quick")
    missing = [name for name in SLOW if not (TESTS / name).exists()]
    if missing:
        raise pytest.UsageError(f"{__file__}: SLOW names {', '.join(missing)}, which are not there; correct the list")


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave slow files unread where they are not wanted: what they import takes seconds, too."""
    return True if config.getoption("markexpr") == "not slow" and is_slow(collection_path) else None


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests of slow files and folders."""
    for item in items:
        if is_slow(item.path):
            item.add_marker(pytest.mark.slow)


def is_slow(path: Path) -> bool:
    """Return whether a file or folder is on the list, or below a folder on it."""
    return any(path == place or place in path.parents for place in (TESTS / name for name in SLOW))
