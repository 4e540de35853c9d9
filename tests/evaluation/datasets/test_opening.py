"""Contract of all layouts: recognition, options, messages about damaged copies."""

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

CopyMaker = Callable[[str], Path]


@pytest.fixture(scope="session")
def location_of(tmp_path_factory: pytest.TempPathFactory) -> CopyMaker:
    """Return a function that makes each copy once and returns its path; tests must not change it."""
    folders: dict[Callable[[Path], None], Path] = {}

    def location(name: str) -> Path:
        copy = COPIES[name]
        if copy.make not in folders:
            folders[copy.make] = tmp_path_factory.mktemp("copy")
            copy.make(folders[copy.make])
        return folders[copy.make] / copy.subfolder

    return location


def options_of(copy: MadeUp) -> DataOptions:
    return DataOptions(partial=copy.partial)


@pytest.mark.parametrize("name", COPIES)
def test_fulfils_reader_contract(name: str, location_of: CopyMaker) -> None:
    location = location_of(name)
    data = open_scenes(location, options=options_of(COPIES[name]))
    assert data.layout == COPIES[name].layout
    assert data.location == str(location)
    contract.check(data)
    note = data.treatment.get("reader", "")
    assert note.startswith("not verified against a published copy") is (data.layout not in VERIFIED)
    assert any(isinstance(scene, MixedScene) for scene in data.scenes) == (data.layout == "lsmi")


# Layouts that are the user's own, or whose readers were tested on published copies.
VERIFIED = {"generated", "thumbnails", "folder"}


@pytest.mark.parametrize("name", COPIES)
def test_recognises_layout(name: str, location_of: CopyMaker) -> None:
    location = location_of(name)
    assert layout_of(str(location)) == COPIES[name].layout
    if location.is_dir():
        layouts = [key for key, layout in LAYOUTS.items() if not layout.is_generic and layout.matches(Folder(location))]
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
def test_options_select_images_and_ground_truths(
    name: str, options: DataOptions, first: str, truth: list[float], location_of: CopyMaker
) -> None:
    scene = open_scenes(location_of(name), options=options).scenes[0]
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
def test_incomplete_copy_requires_partial(name: str, file: str, location_of: CopyMaker, tmp_path: Path) -> None:
    complete, copy = open_scenes(location_of(name)).scenes, tmp_path / "copy"
    shutil.copytree(location_of(name), copy)
    (copy / file).unlink()
    with pytest.raises(FormatError):
        open_scenes(copy)
    remaining = {
        scene.name: scene.truth.tolist() for scene in open_scenes(copy, options=DataOptions(partial=True)).scenes
    }
    assert len(remaining) == len(complete) - 1
    assert remaining.items() <= {scene.name: scene.truth.tolist() for scene in complete}.items()


@pytest.mark.parametrize("name", [name for name, copy in COPIES.items() if copy.layout != "thumbnails"])
def test_opening_reads_no_image(name: str, location_of: CopyMaker, monkeypatch: pytest.MonkeyPatch) -> None:
    location = location_of(name)
    never = Mock(side_effect=AssertionError("an image is read"))
    monkeypatch.setattr("evaluation.datasets.files.decode_image", never)
    monkeypatch.setattr("evaluation.datasets.published.cube.decode_image", never)
    monkeypatch.setattr(np, "load", never)
    assert open_scenes(location, options=options_of(COPIES[name])).scenes


@pytest.mark.parametrize("name", ["cube-plus", "nus8", "intel-tau", "lsmi", "ffcc", "folder"])
def test_ignores_hidden_system_files(name: str, location_of: CopyMaker, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(location_of(name), copy)
    for folder, _, files in os.walk(copy):
        for file in files:
            (Path(folder) / f"._{file}").write_bytes(b"resource fork")
        (Path(folder) / ".DS_Store").write_bytes(b"finder")
    names = [scene.name for scene in open_scenes(location_of(name)).scenes]
    assert [scene.name for scene in open_scenes(copy).scenes] == names


@pytest.mark.parametrize("layout", [key for key, layout in LAYOUTS.items() if layout.path_type == "folder"])
def test_refuses_file_for_folder_layout(layout: str, location_of: CopyMaker, tmp_path: Path) -> None:
    archive = location_of("thumbnails")
    with pytest.raises(FormatError, match=rf"\.npz is a file, expected a folder of .*\({re.escape(layout)}\)"):
        open_scenes(archive, layout)
    with pytest.raises(FormatError):
        open_scenes(tmp_path / "nowhere", layout)
    with pytest.raises(FormatError):
        open_scenes(tmp_path, "thumbnails")


def test_refuses_results_folder(tmp_path: Path) -> None:
    # Its errors.csv has the columns of a table of images.
    (tmp_path / "errors.csv").write_text("image,method,r,g,b\na,grey,1,1,1\na,white,1,1,1\n")
    (tmp_path / "run.json").write_text("{}")
    for location in (tmp_path, tmp_path / "errors.csv"):
        with pytest.raises(FormatError):
            open_scenes(location)


def test_requires_layout_if_two_match(location_of: CopyMaker, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(location_of("nus8 camera"), copy)
    (copy / "cube+_gt.txt").write_text("1 1 1\n")
    with pytest.raises(InputError, match=r"nus8.*--read layout"):
        open_scenes(copy)
    assert open_scenes(copy, "nus8").layout == "nus8"


def test_refuses_inapplicable_option(location_of: CopyMaker, dataset: Path) -> None:
    with pytest.raises(InputError, match=r"--read camera.*Cube\+.*nus8, gehler-shi"):
        open_scenes(location_of("cube-plus"), options=DataOptions(camera="SonyA57"))
    with pytest.raises(InputError, match="--read black"):
        open_scenes(dataset, options=DataOptions(black=3))


@pytest.mark.parametrize("name", COPIES)
def test_error_names_truncated_or_missing_image(name: str, location_of: CopyMaker, tmp_path: Path) -> None:
    copy = COPIES[name]
    if copy.layout == "thumbnails":
        return
    location = location_of(name) if location_of(name).is_dir() else location_of(name).parent
    folder = tmp_path / location.name
    shutil.copytree(location, folder)
    data = open_scenes(folder, options=options_of(copy))
    scene = data.scenes[0]
    assert isinstance(scene, RawScene)
    path = Path(scene.path)
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    with pytest.raises(FormatError) as refusal:
        scene.read()
    assert path.name in str(refusal.value)
    path.unlink()
    with pytest.raises(FormatError) as refusal:
        scene.read()
    assert path.name in str(refusal.value)


# Files of the copies that are quick to read, of every type.
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


def use(location: Path, partial: bool) -> None:
    """Read everything that the commands read."""
    for scene in open_scenes(location, options=DataOptions(partial=partial)).scenes:
        scene.read()
        assert scene.truth.shape == (3,)
        assert scene.saturation is None or np.isfinite(scene.saturation)
        if isinstance(scene, MixedScene):
            scene.read_truth_map()


@st.composite
def damages(draw: st.DrawFn) -> tuple[float, bytes, bool]:
    """Draw the position of a damage as a fraction of the length, the new bytes, and whether the file ends there."""
    texts = st.sampled_from(
        [b"", b"\n", b",", b"nan", b"-1", b"1e999", b'"', b"0 0 0", b"\x00", b"\xff\xfe", b"{}", b"[]"]
    )
    return draw(st.floats(0, 1)), draw(st.one_of(texts, st.binary(max_size=4))), draw(st.booleans())


@pytest.mark.parametrize(("name", "file"), [(name, file) for name, files in FILES.items() for file in files])
@pytest.mark.filterwarnings("ignore")  # libraries may warn about damaged files
def test_damaged_file_raises_input_error(name: str, file: str, tmp_path: Path) -> None:
    copy = COPIES[name]
    copy.make(tmp_path)
    location = tmp_path / copy.subfolder
    path = location / file
    content = path.read_bytes()
    use(location, copy.partial)

    @settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
    @given(damages())
    def damage(change: tuple[float, bytes, bool]) -> None:
        fraction, inserted, is_cut = change
        start = int(fraction * len(content))
        path.write_bytes(content[:start] + inserted + (b"" if is_cut else content[start + len(inserted) :]))
        faults: list[str] = []
        try:
            use(location, copy.partial)
        except InputError as error:
            faults.append(str(error))
        assert all(str(location) in fault for fault in faults)

    damage()
