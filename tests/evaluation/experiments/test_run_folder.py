"""Results folders: the same bytes wherever a run was killed, and nothing taken from another run.

The journal of a run: what is cut off at any byte is taken up again, and another run's is refused.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from evaluation.datasets import open_scenes
from evaluation.experiments import run_folder
from evaluation.experiments.run_folder import append_answers, read_journal, run_methods
from evaluation.learning.model_files import StoredMethod, provenance_of
from evaluation.learning.standard import standard_learners
from evaluation.methods import GrayEdge
from evaluation.metrics import MapError, RegionError
from evaluation.results.result import SceneAnswer
from evaluation.scene import Scene, SceneSet
from foundation.clock import SystemClock
from foundation.errors import InputError
from foundation.files import partial_path
from foundation.folders import held_folder
from tests.evaluation.made_up import MixedWall, Wall, as_set, walls

IDENTITY = {"methods": [{"name": "A", "settings": {"p": 1 / 3}}], "software": "x 1", "several lights": (False, True)}
ANSWERS = [
    (SceneAnswer((0.1, 0.2, 1 / 3)), SceneAnswer(None, "returned None")),
    (SceneAnswer((0.6, 0.8, 0.0), "", MapError(1.0, 2.0, float("inf"), (RegionError(1, 0.25, 3.0, 4.0),))),) * 2,
    (SceneAnswer((1.0, 0.0, 0.0)), SceneAnswer((0.0, 1.0, 0.0))),
]


def written(path: Path) -> bytes:
    """Return the bytes of the journal of all answers."""
    assert read_journal(path, IDENTITY) == []
    with path.open("ab", buffering=0) as stream:
        for image, answers in enumerate(ANSWERS):
            append_answers(stream, image, answers, path.parent)
    return path.read_bytes()


def test_answers_come_back_to_the_last_bit(tmp_path: Path) -> None:
    path = tmp_path / "journal"
    written(path)
    assert read_journal(path, IDENTITY) == ANSWERS


def test_a_journal_cut_anywhere_goes_on_where_it_was_whole(tmp_path: Path) -> None:
    path = tmp_path / "journal"
    whole = written(path)
    ends = [place + 1 for place, byte in enumerate(whole) if byte == ord("\n")]
    for cut in {
        *range(0, len(whole), 41),
        *(end + off for end in ends for off in (-1, 0, 1) if end + off <= len(whole)),
    }:
        path.write_bytes(whole[:cut])
        known = read_journal(path, IDENTITY)
        assert known == ANSWERS[: max(0, sum(end <= cut for end in ends) - 1)]
        with path.open("ab", buffering=0) as stream:
            for image in range(len(known), len(ANSWERS)):
                append_answers(stream, image, ANSWERS[image], tmp_path)
        assert path.read_bytes() == whole


@pytest.mark.parametrize("junk", [b"\0" * 50, b"deadbeef {}\n", b"\n"])
def test_what_a_crash_left_behind_is_cut_off(tmp_path: Path, junk: bytes) -> None:
    path = tmp_path / "journal"
    whole = written(path)
    path.write_bytes(whole + junk)
    assert read_journal(path, IDENTITY) == ANSWERS
    assert path.read_bytes() == whole


def test_a_changed_byte_ends_what_is_believed(tmp_path: Path) -> None:
    path = tmp_path / "journal"
    whole = written(path)
    place = whole.index(b"0.6")
    path.write_bytes(whole[:place] + b"0.7" + whole[place + 3 :])
    assert read_journal(path, IDENTITY) == ANSWERS[:1]


def test_another_run_is_refused_and_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "journal"
    whole = written(path)
    other = json.loads(json.dumps(IDENTITY)) | {"software": "x 2", "treatment": {}}
    with pytest.raises(InputError, match="software and treatment differ"):
        read_journal(path, other)
    assert path.read_bytes() == whole


def test_a_run_that_answered_nothing_gives_way(tmp_path: Path) -> None:
    path = tmp_path / "journal"
    assert read_journal(path, IDENTITY) == []
    other = IDENTITY | {"software": "x 2"}
    assert read_journal(path, other) == []
    alone = path.read_bytes()
    path.unlink()
    read_journal(path, other)
    assert path.read_bytes() == alone


pytestmark = pytest.mark.slow

METHODS = [GrayEdge("Gray-world", 0, 1, 0, 0), GrayEdge("White-Patch", 0, np.inf, 0, 0)]
LIGHTS = np.array([[2.0, 1, 1], [1, 1, 1]])
COUNT = 5


def mixed_set(log: list[str] | None = None) -> SceneSet:
    scenes: tuple[Scene, ...] = (*walls(COUNT - 1, log), MixedWall("mixed.png", LIGHTS))
    return as_set(scenes)


def content(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


class Killed(BaseException):
    """The end of a process, wherever it is."""


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("results") / "out"
    run_methods(mixed_set(), METHODS, folder)
    assert not partial_path(folder).exists()
    return folder


@pytest.fixture(scope="module")
def undisturbed(whole: Path) -> dict[str, bytes]:
    return content(whole)


@pytest.mark.parametrize(("done", "workers"), [(2, 3), (COUNT, 1)])
def test_killed_after_any_image_it_ends_the_same(
    tmp_path: Path, undisturbed: dict[str, bytes], done: int, workers: int
) -> None:
    folder = tmp_path / "out"

    def kill(count: int, _: int) -> None:
        if count == done:
            raise Killed

    with pytest.raises(Killed):
        run_methods(mixed_set(), METHODS, folder, workers=workers, on_scene=kill)
    assert not folder.exists()
    log: list[str] = []
    counts: list[int] = []
    run_methods(mixed_set(log), METHODS, folder, workers=workers, on_scene=lambda count, _: counts.append(count))
    assert counts == list(range(done, COUNT + 1))
    assert content(folder) == undisturbed
    assert not partial_path(folder).exists()


def test_killed_while_files_are_written_it_ends_the_same(
    tmp_path: Path, undisturbed: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, write_whole = tmp_path / "out", run_folder.write_whole
    left = iter(range(4))

    def writes(path: Path, text: str) -> None:
        if next(left, None) is None:
            path.with_name(f".{path.name}.partial").write_text(text[: len(text) // 2])
            raise Killed
        write_whole(path, text)

    with monkeypatch.context() as patched:
        patched.setattr(run_folder, "write_whole", writes)
        with pytest.raises(Killed):
            run_methods(mixed_set(), METHODS, folder)
    assert not folder.exists()
    counts: list[int] = []
    run_methods(mixed_set(), METHODS, folder, on_scene=lambda count, _: counts.append(count))
    assert counts == [COUNT]  # No image is estimated a second time.
    assert content(folder) == undisturbed


def _stopped(folder: Path) -> bytes:
    def kill(count: int, _: int) -> None:
        if count == 2:
            raise Killed

    with pytest.raises(Killed):
        run_methods(mixed_set(), METHODS, folder, on_scene=kill)
    return next(partial_path(folder).iterdir()).read_bytes()


def _other_truth() -> SceneSet:
    scenes: list[Any] = list(mixed_set().scenes)
    scenes[3] = type(scenes[3])(scenes[3].name, scenes[3].truth * (1, 1, 1.001), 3)
    return as_set(tuple(scenes))


def _other_treatment() -> SceneSet:
    return SceneSet("Walls", "made up", "nowhere", mixed_set().scenes, {"black level": "129"})


@pytest.mark.parametrize(
    ("data", "methods", "what"),
    [
        (_other_truth, METHODS, "data set"),
        (_other_treatment, METHODS, "treatment"),
        (mixed_set, [METHODS[0], GrayEdge("White-Patch", 0, 9, 0, 0)], "methods"),
        (mixed_set, METHODS[:1], "methods"),
    ],
)
def test_what_another_run_has_made_is_not_taken(
    tmp_path: Path, data: Callable[[], SceneSet], methods: list[GrayEdge], what: str
) -> None:
    folder = tmp_path / "out"
    before = _stopped(folder)
    with pytest.raises(InputError, match=rf"\.out\.partial.*{what} differ"):
        run_methods(data(), methods, folder)
    assert next(partial_path(folder).iterdir()).read_bytes() == before


def test_changed_pixels_are_noticed(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    before = _stopped(folder)
    scenes: list[Any] = list(mixed_set().scenes)
    scenes[0] = Wall(scenes[0].name, scenes[0].truth, seed=99)
    with pytest.raises(InputError, match=r"answers otherwise for wall 0\.png"):
        run_methods(as_set(tuple(scenes)), METHODS, folder)
    assert next(partial_path(folder).iterdir()).read_bytes() == before


def test_a_true_light_without_a_channel_is_judged() -> None:
    run_methods(as_set((Wall("red", np.array([1.0, 0, 0])),)), [METHODS[0]])


def test_two_programs_do_not_work_on_one_folder(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    with held_folder(partial_path(folder), "busy"), pytest.raises(InputError, match="another program works on"):
        run_methods(mixed_set(), METHODS, folder)


def test_what_is_there_is_kept(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine").touch()
    log: list[str] = []
    with pytest.raises(InputError, match="already exists"):
        run_methods(as_set(walls(2, log)), METHODS, tmp_path / "out")
    assert not log


def test_two_methods_of_one_name_are_refused() -> None:
    with pytest.raises(InputError, match="'Gray-world'"):
        run_methods(mixed_set(), [METHODS[0], GrayEdge("Gray-world", 0, 2, 0)])


class Flat:
    """A model that always sees the same light."""

    def lights(self, features: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
        return np.ones((len(features), 3))

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        return {"seen": np.ones(3)}


def test_a_model_judged_on_what_it_was_trained_on_is_said_to_be() -> None:
    data, other = as_set(walls(3)), as_set(walls(4))
    record = provenance_of(data, 0, SystemClock())
    learner = standard_learners()["regression-trees"]
    model = StoredMethod(learner, Flat(), data.name, record)
    (part,) = run_methods(other, [model]).notes
    assert ": 3 of 4 images were trained on, by name and light or by source picture" in part
    # The name of the data set, the order of its images and the endings of their names may be others.
    renamed = tuple(Wall(f"copies/{Path(wall.name).stem.upper()}.TIF", wall.truth) for wall in reversed(walls(4)))
    assert ": 3 of 4 images were trained on" in run_methods(replace(as_set(renamed), name="Others"), [model]).notes[0]
    others = tuple(Wall(f"other {wall.name}", wall.truth) for wall in walls(4))
    assert "none of these has the name and light" in run_methods(as_set(others), [model]).notes[0]
    assert run_methods(replace(as_set(others), name="Others"), [model]).notes == ()
    # A model file from before images were told apart knows only the name of the data set.
    old = replace(model, provenance=replace(record, images=record.images[:0]))
    assert "whether these are among them is not known" in run_methods(other, [old]).notes[0]
    (note,) = run_methods(data, [model]).notes
    assert note.startswith(f"{learner.name} (trained on Walls) was trained on these very images")


def test_answers_for_other_pixels_of_the_same_images_are_not_taken(tmp_path: Path) -> None:
    images = np.random.default_rng(0).random((4, 8, 9, 3), np.float32)

    def thumbnails(pixels: npt.NDArray[np.float32]) -> SceneSet:
        np.savez(tmp_path / "set.npz", images=pixels, gt=np.ones((4, 3)), names=np.array(list("abcd")))
        return open_scenes(tmp_path / "set.npz")

    def kill(count: int, _: int) -> None:
        if count == 2:
            raise Killed

    with pytest.raises(Killed):
        run_methods(thumbnails(images), METHODS, tmp_path / "out", on_scene=kill)
    with pytest.raises(InputError, match="its data set differ"):
        run_methods(thumbnails(images[..., ::-1]), METHODS, tmp_path / "out")
    taken_up = run_methods(thumbnails(images), METHODS, tmp_path / "out")
    for one, other in zip(taken_up.results, run_methods(thumbnails(images), METHODS).results, strict=True):
        np.testing.assert_array_equal(one.estimates, other.estimates)
