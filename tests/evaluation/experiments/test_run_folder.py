"""Results folders: complete or absent, reproducible, with notes on models tested on training images."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from evaluation.experiments import run_folder
from evaluation.experiments.run_folder import run_methods, write_run
from evaluation.learning.model_files import StoredMethod, provenance_of
from evaluation.learning.standard import standard_learners
from evaluation.methods import GrayEdge
from evaluation.scene import Scene, SceneSet
from foundation.clock import SystemClock
from foundation.errors import InputError
from tests.evaluation.made_up import MixedWall, Wall, as_set, walls

pytestmark = pytest.mark.slow

METHODS = [GrayEdge("Gray-world", 0, 1, 0, 0), GrayEdge("White-Patch", 0, np.inf, 0, 0)]
LIGHTS = np.array([[2.0, 1, 1], [1, 1, 1]])


def mixed_set() -> SceneSet:
    scenes: tuple[Scene, ...] = (*walls(4), MixedWall("mixed.png", LIGHTS))
    return as_set(scenes)


def content(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


class Killed(BaseException):
    """End of the process at an arbitrary point."""


def test_files_do_not_depend_on_workers(tmp_path: Path) -> None:
    counts: list[int] = []
    for workers in (1, 3):
        run = run_methods(mixed_set(), METHODS, workers, lambda: counts.append(1))
        write_run(run, mixed_set().scenes, tmp_path / str(workers), workers=workers)
    assert len(counts) == 2 * 5
    first, second = content(tmp_path / "1"), content(tmp_path / "3")
    assert first == second
    assert set(first) == {
        *("run.json", "results.csv", "errors.csv", "table.tex", "report.html", "pixels.csv", "regions.csv"),
    }


def test_interrupted_writing_leaves_no_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder, write_atomic = tmp_path / "out", run_folder.write_atomic
    run = run_methods(mixed_set(), METHODS)
    remaining = iter(range(4))

    def writes(path: Path, text: str) -> None:
        if next(remaining, None) is None:
            raise Killed
        write_atomic(path, text)

    with monkeypatch.context() as patched:
        patched.setattr(run_folder, "write_atomic", writes)
        with pytest.raises(Killed):
            write_run(run, mixed_set().scenes, folder)
    assert not folder.exists()
    write_run(run, mixed_set().scenes, folder)
    assert len(content(folder)) == 7


def test_ground_truth_with_zero_channel_has_error() -> None:
    run_methods(as_set((Wall("red", np.array([1.0, 0, 0])),)), [METHODS[0]])


def test_existing_folder_is_kept(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine").touch()
    with pytest.raises(InputError):
        write_run(run_methods(mixed_set(), METHODS), mixed_set().scenes, tmp_path / "out")
    assert list(content(tmp_path / "out")) == ["mine"]


class Flat:
    """A model that always returns the same illuminant."""

    def lights(self, features: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
        return np.ones((len(features), 3))

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        return {"seen": np.ones(3)}


def test_reports_model_tested_on_training_data() -> None:
    data, larger_set = as_set(walls(3)), as_set(walls(4))
    record = provenance_of(data, 0, SystemClock())
    learner = standard_learners()["regression-trees"]
    model = StoredMethod(learner, Flat(), data.name, record)
    (first_note,) = run_methods(larger_set, [model]).notes
    assert ": 3 of 4 images were used for training (same name and ground truth, or same source picture): " in first_note
    # The name of the data set, the order of its images and their file extensions may differ.
    renamed = tuple(Wall(f"copies/{Path(wall.name).stem.upper()}.TIF", wall.truth) for wall in reversed(walls(4)))
    assert (
        ": 3 of 4 images were used for training"
        in run_methods(replace(as_set(renamed), name="Others"), [model]).notes[0]
    )
    renamed_scenes = tuple(Wall(f"other {wall.name}", wall.truth) for wall in walls(4))
    assert "no image was identified as a training image" in run_methods(as_set(renamed_scenes), [model]).notes[0]
    assert run_methods(replace(as_set(renamed_scenes), name="Others"), [model]).notes == ()
    (note,) = run_methods(data, [model]).notes
    assert note.startswith(f"{learner.name} (trained on Walls) was trained on these images")
