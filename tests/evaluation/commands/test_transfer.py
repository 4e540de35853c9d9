"""`evaluate transfer`: its output, files and refusals."""

from __future__ import annotations

import json
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from calibration.table.lut import open_lut
from evaluation.cli import main
from evaluation.datasets.generated import open_generated
from evaluation.experiments.transfer import rows as transfer_rows
from tests.evaluation.experiments.transfer.conftest import Maker, save_pictures, write_table
from tests.json_of import json_of

pytestmark = pytest.mark.slow

OWN = """
import numpy as np

class Map:
    name = "Map of the mean"

    def fit(self, scenes, seed=0):
        means = np.array([self.mean(*scene.read()) for scene in scenes])
        lights = np.array([scene.truth / scene.truth.sum() for scene in scenes])
        self.map = np.linalg.lstsq(means, lights, rcond=None)[0]
        return self

    def mean(self, image, mask=None):
        mean = image.mean(axis=(0, 1))
        return mean / mean.sum()

    def estimate(self, image, saturation=None, mask=None):
        return np.maximum(self.mean(image) @ self.map, 1e-3)
"""


@pytest.fixture(scope="module")
def made_place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a generated set, its pictures, a real one as thumbnails, and a method."""
    folder = tmp_path_factory.mktemp("made")
    save_pictures(folder / "pictures", [f"{number}.png" for number in range(6)])
    Maker(folder, write_table(folder / "lut")).make()
    random = np.random.default_rng(1)
    lights = random.dirichlet([40, 60, 40], 30)
    images = random.uniform(0, 1, (30, 8, 8, 3)) * lights[:, None, None]
    images[:, :2, :2] = 0
    names = np.array([f"real_{number:02d}" for number in range(30)])
    np.savez(folder / "real.npz", images=images.astype(np.float32), gt=lights, names=names)
    (folder / "own.py").write_text(OWN)
    return folder


BASIC = ("transfer", "real.npz", "made", "--method", "own.py:Map, gray-world")


def test_files_are_reproducible(work_folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with np.load("real.npz") as data:
        content = {name: data[name] for name in data.files}
    np.savez("tiny.npz", **content | {"images": content["images"].repeat(8, axis=1).repeat(8, axis=2)})
    arguments = ["transfer", "tiny.npz", *BASIC[2:]]
    assert main([*arguments, "--out", "one", "--workers", "1"]) == 0
    assert "test images 64 px, training sets 24 px" in capsys.readouterr().out
    output = json_of(main, [*arguments, "--out", "two", "--workers", "3"], capsys)
    assert (output["command"], output["test"], output["settings"]["side"]) == ("evaluate transfer", "tiny", 24)
    assert all(table["rows"] for table in output["tables"])
    for path in (work_folder / "one").iterdir():
        assert path.read_bytes() == (work_folder / "two" / path.name).read_bytes(), path.name


@pytest.mark.parametrize(
    ("sides", "trained", "side"),
    [
        ((96, 24), ["odd"], None),
        ((24, 96), ["made", "odd"], 24),
    ],
    ids=["one image is larger", "the second set is larger"],
)
def test_reduces_images_by_sizes_of_whole_sets(
    work_folder: Path, capsys: pytest.CaptureFixture[str], sides: tuple[int, int], trained: list[str], side: int | None
) -> None:
    save_pictures(work_folder / "sources", ["a.png"], 1, sides[0])
    save_pictures(work_folder / "sources", ["b.png", "c.png", "d.png"], 2, sides[1])
    Maker(work_folder, open_lut(work_folder / "lut")).make("odd", pictures=work_folder / "sources")
    with np.load("real.npz") as data:
        content = {name: data[name] for name in data.files}
    np.savez("real.npz", **content | {"images": content["images"].repeat(3, axis=1).repeat(3, axis=2)})
    output = json_of(main, ["transfer", "real.npz", *trained, "--method", "gray-world"], capsys)
    assert output["settings"]["side"] == side


def test_all_ignores_case(work_folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    methods = [json_of(main, [*BASIC[:3], "--method", word], capsys)["settings"]["methods"] for word in ("ALL", "all")]
    assert methods[0] == methods[1]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--method", "magic"), "'magic'"),
        (("--method", "kernel-rdge"), "kernel-rdge"),
        (("--method", "own.py:Map, ./own.py:Map"), "given twice"),
        (("made/../made",), "two training sets have the name made"),
        (("real.npz",), "real.npz is both training and test"),
        (("--naive", "lut"), "contains no picture"),
        (("--out", "lut"), "lut already exists; choose another place for the results"),
        (("--real", "20,many"), "--real is '20,many', expected numbers of real images"),
    ],
)
def test_refuses_with_one_sentence(
    work_folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...],
    message: str,
) -> None:
    monkeypatch.setattr(
        transfer_rows, "collect_material", Mock(side_effect=AssertionError("no method must be trained"))
    )
    before = sorted(work_folder.rglob("*"))
    assert main([*BASIC, *arguments]) == 2
    assert message in " ".join(capsys.readouterr().err.split())
    assert [path for path in sorted(work_folder.rglob("*")) if "__pycache__" not in path.parts] == before


def test_excludes_printed_test_images(work_folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with np.load("real.npz") as data:
        content = {name: data[name] for name in data.files}
    names = content["names"].copy()
    names[4] = "3"
    np.savez("other.npz", **content | {"names": names})
    assert main(["transfer", "other.npz", *BASIC[2:], "--out", "out"]) == 0
    assert "2 of 12 images of made are also in the test set, by name: 3.png" in capsys.readouterr().out
    assert json.loads((work_folder / "out" / "run.json").read_text())["training"][0]["images"] == 10
    assert len(open_generated("made").scenes) == 12
