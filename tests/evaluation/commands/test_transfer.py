"""`evaluate transfer` as a user meets it: what it prints, writes and refuses."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from evaluation.cli import main
from evaluation.datasets.generated import open_generated
from evaluation.experiments.transfer import rows as transfer_rows
from evaluation.results.files import read_errors
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


BASIC = ("transfer", "--train", "made", "--test", "real.npz", "--methods", "own.py:Map", "--statistics", "gray-world")


def test_nothing_is_called_real_or_generated_that_is_not(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    wish = ("--methods", "own.py:Map", "--statistics", "none", "--out", "out")
    assert main(["transfer", "--train", "real.npz", "--test", "made", *wish]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    tables, told = printed[: printed.index("The test set")], printed[printed.index("The test set") :]
    assert "in parts of the same method's cross-validation on made (generated)" in tables
    assert "cross-validated on made (generated)" in tables
    assert "real: as it is" in tables
    assert "real cross-validation" not in tables
    assert "real, cross-validated" not in tables
    assert "as good as real" not in tables
    assert "real: generated" not in tables
    assert "The test set made was made by generate: nothing here says what is reached on real images" in told
    assert "real was not made by generate: its rows say nothing of generated images" in told
    page = (place / "out" / "report.html").read_text()
    assert "trained on real (not generated) and tested on 12 images of made (generated)" in page
    assert "trained on generated images" not in page
    assert {row["data"] for row in csv.DictReader((place / "out" / "results.csv").read_text().splitlines())} == {
        *("made", "real")
    }


def test_the_same_command_gives_the_same_bytes(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    wish = [*BASIC, "--images", "7", "--side", "6"]
    assert main([*wish, "--out", "one", "--workers", "1"]) == 0
    printed = capsys.readouterr().out
    assert "All images were made small to at most 6 px" in printed
    assert "sides of up to" not in printed
    found = json_of(main, [*wish, "--out", "two", "--workers", "3"], capsys)
    assert (found["command"], found["test"], found["settings"]["side"]) == ("evaluate transfer", "real", 6)
    assert all(table["rows"] for table in found["tables"])
    for path in (place / "one").iterdir():
        assert path.read_bytes() == (place / "two" / path.name).read_bytes(), path.name


def test_only_some_images_are_tested(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    halves = [[f"real_{n:02d}" for n in range(30) if n % 2 == half] for half in (0, 1)]
    for number, names in enumerate(halves):
        Path(f"half{number}.csv").write_text("image\n" + "\n".join(names) + "\n")
    Path("folds.csv").write_text("image,fold\n" + "".join(f"real_{n:02d},{n // 15}\n" for n in range(30)))
    wish = [*BASIC, "--folds", "folds.csv", "--out"]
    assert main([*wish, "whole"]) == 0
    assert Path("whole/folds_0.csv").read_text() == Path("folds.csv").read_text()
    assert json.loads(Path("whole/run.json").read_text())["settings"]["folds"] == "folds.csv"
    for number in range(2):
        assert main([*wish, f"part{number}", "--only", f"half{number}.csv"]) == 0
    assert "15 of the 30 images of real count, those of half1.csv" in capsys.readouterr().out
    # Cross-validation is that of all thirty: trained on fifteen, whichever are tested.
    whole, parts = read_errors("whole"), [read_errors(f"part{number}") for number in range(2)]
    for method, every in whole.items():
        known = dict(zip(every.images, every.errors["recovery"].tolist(), strict=True))
        for part, names in zip(parts, halves, strict=True):
            assert list(part[method].images) == names
            assert part[method].errors["recovery"].tolist() == [known[name] for name in names]
    lines = list(csv.DictReader(Path("part0/results.csv").read_text().splitlines()))
    assert {line["images"] for line in lines if line["training"] == "cross-validation"} == {"15"}
    assert Path("part0/folds_0.csv").read_text() == Path("whole/folds_0.csv").read_text()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--test", "made"), "made is both training and test"),
        (("--methods", "magic"), "'magic' is no method that learns; expected regression-trees"),
        (("--methods", "kernel-rdge"), "did you mean 'kernel-ridge'? expected regression-trees"),
        (("--statistics", "magic"), "'magic'"),
        (("--images", "13"), "13 training images of 12 were asked for"),
        (("--folds", "31"), "31 folds of 30 images"),
        (("--only", "none.csv"), "cannot read images from none.csv"),
        (("--only", "own.py"), "expected image among them"),
        (("--folds", "none.csv"), "cannot read folds from none.csv"),
        (("--naive", "lut"), "holds no picture"),
        (("--naive", "pictures", "--matrix", "Pinhole"), "'Pinhole' is neither a file nor a camera"),
        (("--matrix", "Canon EOS 550D"), "--naive PICTURES"),
        (("--train", "made/../made"), "two training sets are called made"),
        (("--out", "lut"), "lut already exists; name another place for the results"),
        (("--real", "20,many"), "--real is '20,many', expected numbers of real images between commas, or all"),
        (("--real", "5", "--beside", "blended"), "--beside is 'blended', expected pooled, adapted"),
    ],
)
def test_what_cannot_be_done_is_one_sentence(
    place: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...],
    message: str,
) -> None:
    def never(*given: object) -> None:
        pytest.fail("no method must be trained")

    monkeypatch.setattr(transfer_rows, "gather", never)
    before = sorted(place.rglob("*"))
    assert main([*BASIC, *arguments]) == 2
    assert message in " ".join(capsys.readouterr().err.split())
    assert [path for path in sorted(place.rglob("*")) if "__pycache__" not in path.parts] == before


def test_test_images_that_were_printed_are_refused(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with np.load("real.npz") as data:
        content = {name: data[name] for name in data.files}
    names = content["names"].copy()
    names[4] = "3"
    np.savez("other.npz", **content | {"names": names})
    wish = [*BASIC[:4], "other.npz", *BASIC[5:]]
    assert main(wish) == 2
    assert "2 of 12 images of made are also in the test set, by name: 3.png" in capsys.readouterr().err
    assert main([*wish, "--shared", "leave-out", "--out", "out"]) == 0
    assert json.loads((place / "out" / "run.json").read_text())["training"][0]["images"] == 10
    assert len(open_generated("made").scenes) == 12


def test_training_images_that_are_blue_first_are_told(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    random = np.random.default_rng(2)
    for name, order in (("test", slice(0, 3)), ("red", slice(0, 3)), ("blue", slice(None, None, -1))):
        lights = random.dirichlet([120, 60, 20], 30)
        images = (random.uniform(0.5, 1, (30, 8, 8, 3)) * lights[:, None, None]).astype(np.float32)
        names = np.array([f"{name} {number}" for number in range(30)])
        np.savez(place / f"{name}.npz", images=images, gt=lights[:, order], names=names)
    trained = ("--train", "red.npz", "--train", "blue.npz")
    wish = ("--test", "test.npz", "--methods", "own.py:Map", "--statistics", "none")
    assert main(["transfer", *trained, *wish]) == 0
    printed = capsys.readouterr().out
    assert "Map of the mean, blue: as it is: with red and blue exchanged" in printed
    assert "Map of the mean, red: as it is: with red and blue exchanged" not in printed


def test_beside_real_images(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    wish = ("--methods", "own.py:Map,kernel-ridge", "--statistics", "none", "--relit", "other.npz", "--out", "out")
    with np.load(place / "real.npz") as content:
        images, lights = content["images"][:, ::-1], content["gt"]
    np.savez(place / "other.npz", images=images, gt=lights, names=np.array([f"other_{number}" for number in range(30)]))
    assert main([*BASIC[:5], *wish, "--real", "0,5,50,all"]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "real: mean reproduction error beside N real images, degrees" in printed
    assert "No rows beside 50 real images: a fold that is tested leaves 20; all are those" in printed
    assert "Map of the mean is a class of your own, which is not adapted" in printed
    lines = list(csv.DictReader((place / "out/results.csv").read_text().splitlines()))
    rows = {(line["method"], line["training"], line["way"], line["real"]) for line in lines}
    ridge = {row[1:] for row in rows if row[0].startswith("Kernel ridge")}
    ways = {(way, real) for way in ("pooled", "adapted") for real in ("5", "all")}
    for kind in ("generated", "relit"):
        assert {row[1:] for row in ridge if row[0] == kind} == {("", ""), *ways}
    assert {row[1:] for row in ridge if row[0] == "real"} == {("alone", "5"), ("alone", "all")}
    assert not any(row[2] == "adapted" for row in rows if row[0] == "Map of the mean")
