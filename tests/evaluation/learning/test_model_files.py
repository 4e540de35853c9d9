"""Model files: contents, and refusal of foreign and damaged files."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evaluation.learning.feature_learner import LearnedMethod
from evaluation.learning.model_files import load_model, save_model, scenes_sha256
from evaluation.learning.regression_trees import RegressionTrees
from evaluation.methods.standard import standard_methods
from foundation.errors import FormatError, InputError
from tests.evaluation.learning.made_up_world import world
from tests.evaluation.learning.stories import story

SCENES = world(12)


@pytest.fixture(scope="module")
def fitted() -> LearnedMethod:
    return RegressionTrees(windows=3).fit(SCENES)


@pytest.fixture
def saved(fitted: LearnedMethod, tmp_path: Path) -> Path:
    save_model(tmp_path / "model.npz", fitted, story(SCENES, "Cube+"))
    return tmp_path / "model.npz"


def test_hash_depends_on_names_ground_truths_and_order() -> None:
    hashes = {
        scenes_sha256(SCENES),
        scenes_sha256(SCENES[::-1]),
        scenes_sha256(SCENES[:11]),
        scenes_sha256(world(12, 1)),
    }
    assert len(hashes) == 4
    assert scenes_sha256(world(12)) == scenes_sha256(SCENES)


def test_saves_only_learned_methods(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="Gray-world cannot be saved"):
        save_model(tmp_path / "model.npz", standard_methods()["gray-world"], story(SCENES))
    assert not list(tmp_path.iterdir())


class Payload:
    """Fails the test if it is unpickled."""

    def __reduce__(self) -> tuple[Any, tuple[str]]:
        return (pytest.fail, ("a pickle was loaded",))


@pytest.mark.parametrize("content", ["text", "empty", "pickle", "pickled array", "thumbnails"])
def test_refuses_foreign_files(tmp_path: Path, content: str) -> None:
    path = tmp_path / "model.npz"
    match content:
        case "text":
            path.write_text("no model")
        case "empty":
            path.write_bytes(b"")
        case "pickle":
            path.write_bytes(pickle.dumps(Payload()))
        case "pickled array":
            np.savez(path, about=np.array([Payload()], dtype=object))
        case "thumbnails":
            np.savez(path, images=np.ones((1, 2, 2, 3)), gt=np.ones((1, 3)), names=np.array(["a"]))
        case _:
            pass
    with pytest.raises(FormatError, match=r"model\.npz.*evaluate train"):
        load_model(path)


def test_detects_damage(saved: Path) -> None:
    content = saved.read_bytes()
    expected = load_model(saved).estimate(SCENES[0].image)
    rng = np.random.default_rng(0)
    for size in rng.integers(0, len(content), 10):
        saved.write_bytes(content[:size])
        with pytest.raises(FormatError):
            load_model(saved)
    refused_count = 0
    for position in rng.integers(0, len(content), 40):
        flipped = bytearray(content)
        flipped[position] ^= 0xFF
        saved.write_bytes(flipped)
        try:
            loaded = load_model(saved)
        except FormatError:
            refused_count += 1
        else:  # Dates and other fields of the archive do not belong to the model.
            np.testing.assert_array_equal(loaded.estimate(SCENES[0].image), expected)
    assert refused_count > 20


def test_refuses_unsupported_compression(saved: Path) -> None:
    content = bytearray(saved.read_bytes())
    # Bit 5 of the flags of the first file, in its header and in the directory: compressed patched data.
    content[content.index(b"PK\x03\x04") + 6] |= 1 << 5
    content[content.index(b"PK\x01\x02") + 8] |= 1 << 5
    saved.write_bytes(content)
    with pytest.raises(FormatError):
        load_model(saved)
