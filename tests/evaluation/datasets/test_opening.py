"""Every layout keeps the contract, is told from every other, and says what it cannot use."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from evaluation.datasets import LAYOUTS, DataOptions, layout_of, open_scenes
from evaluation.datasets.files import Folder, RawScene
from evaluation.scene import MixedScene
from foundation.errors import FormatError, InputError
from tests.evaluation.datasets import contract
from tests.evaluation.datasets.made_up import COPIES, MadeUp

pytestmark = pytest.mark.slow

Place = Callable[[str], Path]


@pytest.fixture(scope="session")
def place_of(tmp_path_factory: pytest.TempPathFactory) -> Place:
    """Return what makes each copy once and gives its place; tests do not change it."""
    made: dict[Callable[[Path], None], Path] = {}

    def place(name: str) -> Path:
        copy = COPIES[name]
        if copy.make not in made:
            made[copy.make] = tmp_path_factory.mktemp("copy")
            copy.make(made[copy.make])
        return made[copy.make] / copy.at

    return place


def options_of(copy: MadeUp) -> DataOptions:
    return DataOptions(partial=copy.partial)


@pytest.mark.parametrize("name", COPIES)
def test_every_layout_keeps_the_contract(name: str, place_of: Place) -> None:
    place = place_of(name)
    data = open_scenes(place, options=options_of(COPIES[name]))
    assert data.layout == COPIES[name].layout
    assert data.location == str(place)
    contract.check(data)
    # Whether the reader was ever tried on a published copy is said with results.
    stated = data.treatment.get("reader", "")
    assert stated.startswith("not verified against a published copy") is (data.layout not in OWN)
    assert any(isinstance(scene, MixedScene) for scene in data.scenes) == (data.layout == "lsmi")


OWN = {"generated", "thumbnails", "folder"}
"""Layouts whose readers have met more than made-up copies, or that are the user's own."""


@pytest.mark.parametrize("name", COPIES)
def test_a_layout_is_told_from_every_other(name: str, place_of: Place) -> None:
    place = place_of(name)
    assert layout_of(str(place)) == COPIES[name].layout
    if place.is_dir():
        layouts = [layout for layout, known in LAYOUTS.items() if not known.general and known.matches(Folder(place))]
        assert layouts in ([COPIES[name].layout], [])


@pytest.mark.parametrize(
    ("name", "options", "first", "truth"),
    [
        ("cube-plus", DataOptions(truth="left"), "1.PNG", [0.25, 0.5, 0.25]),
        ("cube++", DataOptions(truth="right"), "00_0001.png", [0.2, 0.5, 0.3]),
        ("cube++", DataOptions(truth="right-white"), "00_0001.png", [0.21, 0.5, 0.29]),
        ("simple-cube++", DataOptions(subset="test"), "01_0004.png", [0.2, 0.5, 0.3]),
        ("nus8", DataOptions(camera="sonya57"), "SonyA57_0001", [0.1, 0.5, 0.4]),
        ("gehler-shi", DataOptions(camera="5D", partial=True), "IMG_0281.png", [87, 1086, 2086]),
        ("lsmi", DataOptions(subset="single"), "sony/Place1_1.tiff", [0.5, 1, 0.5]),
        ("lsmi", DataOptions(subset="mixed"), "sony/Place1_12.tiff", [1.625 / 3.5, 1 / 3.5, 0.875 / 3.5]),
    ],
)
def test_options_choose_images_and_truths(
    name: str, options: DataOptions, first: str, truth: list[float], place_of: Place
) -> None:
    scene = open_scenes(place_of(name), options=options).scenes[0]
    assert (scene.name, scene.truth.tolist()) == (first, pytest.approx(truth))


@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("cube-plus", "2.PNG"),
        ("nus8", "SonyA57/SonyA57_0003.PNG"),
        ("intel-tau", "Canon_5DSR/field_1_cameras/C_5DSR_field_2.tiff"),
        ("folder", "c.npy"),
    ],
)
def test_a_copy_that_lacks_an_image_is_read_only_as_part(name: str, file: str, place_of: Place, tmp_path: Path) -> None:
    whole, copy = open_scenes(place_of(name)).scenes, tmp_path / "copy"
    shutil.copytree(place_of(name), copy)
    (copy / file).unlink()
    with pytest.raises(FormatError):
        open_scenes(copy)
    left = {scene.name: scene.truth.tolist() for scene in open_scenes(copy, options=DataOptions(partial=True)).scenes}
    assert len(left) == len(whole) - 1
    assert left.items() <= {scene.name: scene.truth.tolist() for scene in whole}.items()


@pytest.mark.parametrize("name", [name for name, copy in COPIES.items() if copy.layout != "thumbnails"])
def test_opening_reads_no_image(name: str, place_of: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    place = place_of(name)

    never = Mock(side_effect=AssertionError("an image is read"))
    monkeypatch.setattr("evaluation.datasets.files.decode_image", never)
    monkeypatch.setattr("evaluation.datasets.published.cube.decode_image", never)
    monkeypatch.setattr(np, "load", never)
    assert open_scenes(place, options=options_of(COPIES[name])).scenes


@pytest.mark.parametrize("name", ["cube-plus", "nus8", "intel-tau", "lsmi", "ffcc", "folder"])
def test_hidden_leftovers_of_systems_are_not_seen(name: str, place_of: Place, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(place_of(name), copy)
    for folder, _, files in os.walk(copy):
        for file in files:
            (Path(folder) / f"._{file}").write_bytes(b"resource fork")
        (Path(folder) / ".DS_Store").write_bytes(b"finder")
    names = [scene.name for scene in open_scenes(place_of(name)).scenes]
    assert [scene.name for scene in open_scenes(copy).scenes] == names


@pytest.mark.parametrize("layout", [name for name, known in LAYOUTS.items() if known.takes == "folder"])
def test_a_file_for_a_layout_of_folders_is_told(layout: str, place_of: Place, tmp_path: Path) -> None:
    archive = place_of("thumbnails")
    with pytest.raises(
        FormatError, match=rf"\.npz is a file, expected a folder of .*\({re.escape(layout)}\); name that"
    ):
        open_scenes(archive, layout)
    with pytest.raises(FormatError):
        open_scenes(tmp_path / "nowhere", layout)
    with pytest.raises(FormatError):
        open_scenes(tmp_path, "thumbnails")


def test_a_results_folder_is_told_from_a_data_set(tmp_path: Path) -> None:
    # Its errors.csv has the columns of a table of images.
    (tmp_path / "errors.csv").write_text("image,method,r,g,b\na,grey,1,1,1\na,white,1,1,1\n")
    (tmp_path / "run.json").write_text("{}")
    for place in (tmp_path, tmp_path / "errors.csv"):
        with pytest.raises(FormatError):
            open_scenes(place)


def test_what_looks_like_two_must_be_named(place_of: Place, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(place_of("nus8 camera"), copy)
    (copy / "cube+_gt.txt").write_text("1 1 1\n")
    with pytest.raises(InputError, match=r"nus8.*--read layout"):
        open_scenes(copy)
    assert open_scenes(copy, "nus8").layout == "nus8"


def test_an_option_without_a_meaning_is_refused(place_of: Place, dataset: Path) -> None:
    with pytest.raises(InputError, match=r"--read camera.*Cube\+.*nus8, gehler-shi"):
        open_scenes(place_of("cube-plus"), options=DataOptions(camera="SonyA57"))
    with pytest.raises(InputError, match="--read black"):
        open_scenes(dataset, options=DataOptions(black=3))


@pytest.mark.parametrize("name", COPIES)
def test_a_truncated_image_is_an_error_with_its_name(name: str, place_of: Place, tmp_path: Path) -> None:
    copy = COPIES[name]
    if copy.layout == "thumbnails":
        return
    place = place_of(name) if place_of(name).is_dir() else place_of(name).parent
    folder = tmp_path / place.name
    shutil.copytree(place, folder)
    data = open_scenes(folder, options=options_of(copy))
    scene = data.scenes[0]
    assert isinstance(scene, RawScene)
    path = Path(scene.path)
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    with pytest.raises(FormatError) as told:
        scene.read()
    assert path.name in str(told.value)
    path.unlink()
    with pytest.raises(FormatError) as told:
        scene.read()
    assert path.name in str(told.value)


FILES = {
    "nus8": ("SonyA57/SonyA57_gt.mat", "SonyA57/SonyA57_0001.PNG"),
    "gehler-shi": ("ColorCheckerData.mat", "coordinates/8D5U5524_macbeth.txt", "Canon1D/png/8D5U5524.png"),
    "intel-tau": ("Canon_5DSR/lab_printouts/C_5DSR_lab_010.wp", "Canon_5DSR/lab_printouts/C_5DSR_lab_10.tiff"),
    "lsmi": (
        *("sony/meta.json", "sony/split.json", "sony/Place1/Place1_12.npy"),
        *("sony/Place2/Place2_123.tiff", "sony/Place1/Place1_1.tiff"),
    ),
    "lsmi prepared": ("train/Place1_mask.png", "train/Place1_12.npy", "meta.json"),
    "ffcc": ("folder_1/000001.txt", "folder_2/000001.png"),
    "thumbnails": ("",),
    "folder": ("gt.csv", "a_mask.png", "more/b.tiff", "c.npy"),
}
"""Files of the copies that are quick to read, those of every kind."""


def use(place: Path, partial: bool) -> None:
    """Do with a data set what the commands do."""
    for scene in open_scenes(place, options=DataOptions(partial=partial)).scenes:
        scene.read()
        assert scene.truth.shape == (3,)
        assert scene.saturation is None or np.isfinite(scene.saturation)
        if isinstance(scene, MixedScene):
            scene.read_truth_map()


@st.composite
def damages(draw: st.DrawFn) -> tuple[float, bytes, bool]:
    """Draw where a file is damaged, as a share of its length, what stands there then, and whether it ends there."""
    texts = st.sampled_from(
        [b"", b"\n", b",", b"nan", b"-1", b"1e999", b'"', b"0 0 0", b"\x00", b"\xff\xfe", b"{}", b"[]"]
    )
    return draw(st.floats(0, 1)), draw(st.one_of(texts, st.binary(max_size=4))), draw(st.booleans())


@pytest.mark.parametrize(("name", "file"), [(name, file) for name, files in FILES.items() for file in files])
@pytest.mark.filterwarnings("ignore")  # Of libraries that read damaged files; what counts is how it ends.
def test_a_damaged_file_is_our_error(name: str, file: str, tmp_path: Path) -> None:
    copy = COPIES[name]
    copy.make(tmp_path)
    place = tmp_path / copy.at
    path = place / file
    whole = path.read_bytes()
    use(place, copy.partial)

    @settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
    @given(damages())
    def damage(how: tuple[float, bytes, bool]) -> None:
        where, instead, cut = how
        at = int(where * len(whole))
        path.write_bytes(whole[:at] + instead + (b"" if cut else whole[at + len(instead) :]))
        faults: list[str] = []
        try:
            use(place, copy.partial)
        except InputError as error:
            faults.append(str(error))
        assert all(str(place) in fault for fault in faults)

    damage()
