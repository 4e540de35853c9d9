"""The commands `evaluate train` and `evaluate cv`."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evaluation.cli import main
from evaluation.learning.model_files import load_model
from tests.evaluation.learning.made_up_world import save_world

pytestmark = pytest.mark.slow


@pytest.fixture
def data(tmp_path: Path) -> Path:
    save_world(tmp_path / "world.npz", 12)
    return tmp_path / "world.npz"


def test_trains_saves_and_uses_model(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model = tmp_path / "models" / "cat.npz"
    assert main(["train", "smart-color-cat", str(data), "--out", str(model), "--seed", "4"]) == 0
    printed = capsys.readouterr().out
    assert "Smart Color Cat, trained on all of world (thumbnails, 12 images, seed 4)" in printed
    assert "mask: pixels that are zero in every channel" in printed
    loaded = load_model(model)
    assert loaded.provenance is not None
    assert loaded.provenance.data_place == str(data)
    assert main(["run", str(data), "--method", str(model)]) == 0
    printed = capsys.readouterr().out
    assert "Smart Color Cat (trained on world)" in printed
    before = model.read_bytes()
    assert main(["train", "smart-color-cat", str(data), "--out", str(model)]) == 2
    assert "already exists" in capsys.readouterr().err
    assert model.read_bytes() == before


def test_trains_several_methods_as_cv_does(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, alone = tmp_path / "models", tmp_path / "alone.npz"
    methods = "smart-color-cat, kernel-ridge"
    assert main(["train", methods, str(data), "--out", str(folder), "--json"]) == 0
    reported = json.loads(capsys.readouterr().out)["models"]
    assert [Path(model["model"]).name for model in reported] == ["smart-color-cat.npz", "kernel-ridge.npz"]
    assert main(["train", "kernel-ridge", str(data), "--out", str(alone)]) == 0
    with np.load(alone) as expected, np.load(folder / "kernel-ridge.npz") as trained:
        arrays = [name for name in expected.files if expected[name].dtype.kind == "f"]
        assert all(np.array_equal(expected[name], trained[name]) for name in arrays)
    assert main(["train", methods, str(data), "--out", str(folder)]) == 2
    assert "already exists" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("method", "out", "reason"),
    [
        ("kernel-ridge,smart-color-cat", "both.npz", "expected a folder"),
        ("kernel-ridge", "model", "ends in .npz"),
        ("kernel-ridge,kernel-ridge", "models", "given twice"),
        (",", "models", "0 methods"),
    ],
)
def test_refuses_methods_and_names_that_do_not_fit(
    method: str, out: str, reason: str, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["train", method, str(data), "--out", str(tmp_path / out)]) == 2
    assert reason in capsys.readouterr().err
    assert not (tmp_path / out).exists()


def test_adapts_model(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    base_file, adapted_file = tmp_path / "before.npz", tmp_path / "after.npz"
    with np.load(data) as content:
        few: dict[str, Any] = {name: content[name][:6] for name in content.files}
    few["names"] = np.array([f"few {number}" for number in range(6)])
    np.savez(tmp_path / "few.npz", **few)
    assert main(["train", "kernel-ridge", str(data), "--out", str(base_file)]) == 0
    capsys.readouterr()
    assert (
        main(
            ["train", "kernel-ridge", str(tmp_path / "few.npz"), "--adapt", str(base_file), "--out", str(adapted_file)]
        )
        == 0
    )
    printed = " ".join(capsys.readouterr().out.split())
    assert "weights of the blend: " in printed
    # Images of either training are reported as training images.
    assert main(["run", str(data), "--method", str(adapted_file)]) == 0
    assert ": 12 of 12 images were used for training" in " ".join(capsys.readouterr().out.split())
    assert (
        main(["train", "smart-color-cat", str(data), "--adapt", str(base_file), "--out", str(tmp_path / "no.npz")]) == 2
    )
    assert "is a model of kernel-ridge, expected smart-color-cat" in " ".join(capsys.readouterr().err.split())


def test_trains_user_class(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mine.py").write_text(
        "import numpy as np\n\n\n"
        "class Mean:\n"
        "    name = 'My mean'\n\n"
        "    def fit(self, scenes, seed=0):\n"
        "        self.light = np.mean([scene.truth / scene.truth.sum() for scene in scenes], axis=0)\n"
        "        return self\n\n"
        "    def estimate(self, image, saturation=None, mask=None):\n"
        "        return self.light\n"
    )
    class_file = f"{tmp_path / 'mine.py'}:Mean"
    assert main(["cv", class_file, str(data)]) == 0
    assert "My mean" in capsys.readouterr().out
    assert main(["train", class_file, str(data), "--out", str(tmp_path / "model.npz")]) == 2
    assert "your own class" in capsys.readouterr().err


def test_all_omits_learners_that_are_not_installed(
    data: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.setitem(sys.modules, "sklearn", None)
    assert main(["cv", "all", str(data), "--folds", "2"]) == 0
    printed = capsys.readouterr().out
    assert "Log-chroma" in printed
    assert "Convolutional network is omitted: training convnet requires torch" in printed
    assert "pip install scikit-learn" in printed
    assert main(["cv", "convnet", str(data)]) == 2
    assert "pip install torch" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["cv", "smart-color-cat", "DATA", "--folds", "none.csv"], "none.csv"),
        (["train", "all", "DATA", "--out", "x.npz"], "expected a folder for several models"),
        (["train", "smart-color-cat", "DATA", "--out", "model.txt"], "ends in .npz"),
    ],
)
def test_refuses_wrong_arguments(
    arguments: list[str],
    message: str,
    data: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(data.parent)
    assert main([str(data) if argument == "DATA" else argument for argument in arguments]) == 2
    assert message in capsys.readouterr().err
    assert [path.name for path in data.parent.iterdir()] == ["world.npz"]


def test_reports_copies_in_several_folds(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    images = np.random.default_rng(0).random((6, 8, 8, 3), np.float32)
    images[4] = images[1]
    names = [f"{number}.png" for number in range(6)]
    np.savez(tmp_path / "set.npz", images=images, gt=np.ones((6, 3)), names=names)
    (tmp_path / "folds.csv").write_text("image,fold\n" + "".join(f"{n}.png,{n % 2}\n" for n in range(6)))
    assert main(["cv", "constant-light", f"{tmp_path}/set.npz", "--folds", f"{tmp_path}/folds.csv"]) == 0
    assert "1 image is a copy of images in other folds (4.png of 1.png)" in capsys.readouterr().out
    assert main(["cv", "constant-light", f"{tmp_path}/set.npz", "--folds", "2"]) == 0
    assert "copies" not in capsys.readouterr().out
