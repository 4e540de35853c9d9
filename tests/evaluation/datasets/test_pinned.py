"""What readers make of copies of every layout, whole and damaged: no change of the code may move it unseen."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evaluation.datasets import DataOptions, open_scenes
from evaluation.datasets.identity import first_copies, identities, known_again
from evaluation.scene import MixedScene, SceneSet
from foundation.errors import CropError
from tests.evaluation.datasets.made_up import COPIES, MadeUp
from tests.pinned import Pinned

pytestmark = pytest.mark.slow

OPTIONS: dict[str, tuple[DataOptions, ...]] = {
    "cube-plus": (DataOptions(truth="left"), DataOptions(truth="right"), DataOptions(black=1000, saturation=6000)),
    "cube++": (
        *(DataOptions(truth=truth) for truth in ("left", "right", "left-white", "right-white", "middle")),
        DataOptions(saturation=3000.5),
    ),
    "simple-cube++": (DataOptions(subset="test"), DataOptions(subset="train"), DataOptions(subset="all")),
    "nus8": (DataOptions(camera="sonya57"), DataOptions(camera="none"), DataOptions(black=3000, saturation=3001)),
    "gehler-shi": (
        *(DataOptions(camera=camera, partial=True) for camera in ("1D", "5D", "7D")),
        DataOptions(truth="shi", partial=True),
        DataOptions(),
    ),
    "intel-tau": (DataOptions(camera="Nikon_D810"), DataOptions(subset="lab_printouts"), DataOptions(subset="x")),
    "lsmi": tuple(DataOptions(subset=part) for part in ("train", "test", "val", "single", "mixed", "train-mixed", "x")),
    "lsmi prepared": (DataOptions(subset="train-single"), DataOptions(black=1, saturation=4096)),
    "ffcc": (DataOptions(black=40, saturation=50),),
    "folder": (DataOptions(black=1, saturation=4200), DataOptions(partial=True), DataOptions(camera="a")),
    "thumbnails": (DataOptions(black=3), DataOptions(saturation=4000)),
}
"""Options beside none; some are refused."""

LARGE = ("cube-plus", "cube++", "simple-cube++", "simple-cube++ train")
"""Copies with images of megapixels, read once."""


def told(data: SceneSet, folder: Path, read: bool) -> dict[str, Any]:
    """Return all that a data set says of itself and of its images."""
    images: list[Any] = []
    for scene in data.scenes:
        one: list[Any] = [scene.name, scene.truth, scene.saturation]
        if read:
            image, mask = scene.read()
            step = 1 + image.size // 100_000  # Of an image of megapixels some pixels are enough.
            one += [image.shape, image[::step, ::step]]
            one += [] if mask is None else [np.packbits(mask.any(axis=0)), np.packbits(mask.any(axis=1)), mask.sum()]
            if isinstance(scene, MixedScene):
                one += [scene.lights, scene.read_weights(), scene.read_truth_map()]
        images.append(one)
    about = {what: text.replace(str(folder), "SET") for what, text in data.treatment.items()}
    folds = None if data.folds is None else list(data.folds)
    return {"name": data.name, "layout": data.layout, "treatment": about, "folds": folds, "images": images}


def attempt(place: Path, folder: Path, options: DataOptions, read: bool) -> Any:
    """Return what a data set says, or why it is refused."""
    try:
        return told(open_scenes(place, options=options), folder, read)
    except CropError as error:
        # What Python says of JSON is its own.
        return re.sub("is no JSON: [^;]*", "is no JSON", str(error).replace(str(folder), "SET"))


@pytest.fixture(scope="module")
def folder_of(tmp_path_factory: pytest.TempPathFactory) -> Callable[[MadeUp], Path]:
    """Return what makes each copy once and gives its folder, always of the same name; tests leave it as it was."""
    made: dict[Callable[[Path], None], Path] = {}

    def folder(copy: MadeUp) -> Path:
        if copy.make not in made:
            made[copy.make] = tmp_path_factory.mktemp("copy") / "set"
            made[copy.make].mkdir()
            copy.make(made[copy.make])
        return made[copy.make]

    return folder


@pytest.mark.parametrize("name", COPIES)
def test_layouts(name: str, folder_of: Callable[[MadeUp], Path], pinned: Pinned) -> None:
    copy = COPIES[name]
    folder = folder_of(copy)
    place = folder / copy.at
    found = [attempt(place, folder, DataOptions(partial=copy.partial), read=True)]
    # Images are others where levels are.
    found += [
        attempt(place, folder, each, name not in LARGE and bool(each.saturation)) for each in OPTIONS.get(name, ())
    ]
    data = open_scenes(place, options=DataOptions(partial=copy.partial))
    marks = identities(data.scenes)
    again = known_again(data.scenes, marks[:1])
    pinned(
        f"data set, {name}", [found, [f"{one:x}" for one in marks.ravel().tolist()], again, first_copies(data.scenes)]
    )


def damages(text: str) -> Iterator[tuple[str, str]]:
    """Yield a text of a data set, damaged in several ways, each with its name."""
    lines = text.splitlines(keepends=True)
    last = lines[-1]
    yield "empty", ""
    yield "without its end", "".join(lines[:-1])
    yield "its end twice", text + ("" if text.endswith("\n") else "\n") + last
    yield "without its head", "".join(lines[1:])
    digits = [place for place, mark in enumerate(last) if mark.isdigit() or mark == "."]
    for instead in ("-", "x", "nan ", "inf ", "0 0 0 ", ",", '"'):
        if digits:
            at = digits[len(digits) // 2]
            yield f"with {instead.strip()}", text[: len(text) - len(last) + at] + instead + last[at:]
    yield "no number but 0", "".join("0" if mark in "123456789" else mark for mark in text)


@pytest.mark.parametrize("name", [name for name in COPIES if " " not in name and name not in ("thumbnails", "nus8")])
def test_damaged_texts(name: str, folder_of: Callable[[MadeUp], Path], pinned: Pinned) -> None:
    copy = COPIES[name]
    folder = folder_of(copy)
    texts = [path for path in sorted(folder.rglob("*")) if path.suffix in (".txt", ".csv", ".json", ".wp")]
    found: dict[str, Any] = {}
    for path in texts[:6]:
        whole = path.read_text()
        for how, damaged in damages(whole):
            path.write_text(damaged)
            data: Any = attempt(folder / copy.at, folder, DataOptions(partial=copy.partial), name not in LARGE)
            if not isinstance(data, str):
                data = [data["treatment"].get("images"), data["folds"], *(one[:2] + one[5:] for one in data["images"])]
            found[f"{path.relative_to(folder).as_posix()} {how}"] = data
        path.write_text(whole)
    pinned(f"damaged data set, {name}", found)
