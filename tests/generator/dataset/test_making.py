"""Generating data sets: content, repeated commands, and engines."""

from __future__ import annotations

import csv
import hashlib
import json
import logging
import os
import shutil
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import cv2
import numpy as np
import psutil
import pytest

from foundation.errors import FormatError, InputError
from generator import open_lut
from generator.cli import main
from generator.dataset.making import Workers, generate_dataset, parse_engine
from generator.dataset.plan import DatasetOptions
from generator.dataset.reader import Dataset, open_dataset
from generator.dataset.shards import SILENT, Callbacks
from generator.lights.lighting import ListedLights, RandomLights, mixture_of
from generator.pictures.random_scenes import random_scenes
from generator.pictures.sources import find_pictures, read_picture
from generator.rendering.render import render
from tests.generator.conftest import MakeLut, lut_in
from tests.generator.dataset.contents import contents

if TYPE_CHECKING:
    from calibration.table.lut import Lut


# Image numbers for `pictures` under two illuminants; the numbers of the third picture are not used.
NUMBERS = (0, 1, 2, 3, 6, 7, 8, 9)


@pytest.fixture
def pictures(tmp_path: Path) -> Path:
    """Return a folder of five pictures; the third is damaged."""
    folder = tmp_path / "pictures"
    (folder / "more").mkdir(parents=True)
    rng = np.random.default_rng(2)
    for name, shape in (("a.png", (20, 30)), ("b, c.png", (31, 17)), ("more/d.png", (8, 600)), ("more/e.png", (9, 9))):
        coarse = rng.integers(0, 256, (shape[0], shape[1], 3)).astype(np.uint8)
        (folder / name).write_bytes(cv2.imencode(".png", coarse)[1].tobytes())
    (folder / "broken.jpg").write_bytes(b"no picture")
    return folder


@pytest.mark.slow
def test_content_of_data_set(make_lut: MakeLut, pictures: Path, tmp_path: Path) -> None:
    lut = make_lut()
    skipped: list[tuple[str, str]] = []
    images: list[int] = []
    data_set = generate_dataset(
        lut,
        tmp_path / "out",
        find_pictures([pictures]),
        [2, 1],
        seed=77,
        workers=2,
        callbacks=Callbacks(
            on_image=lambda: images.append(1),
            on_skip=lambda name, reason, missed: skipped.append((name, f"{reason} ({missed} images)")),
        ),
    )
    assert len(images) == 8
    assert [name for name, _ in skipped] == ["broken.jpg"]
    assert "JPEG" in skipped[0][1]
    assert skipped[0][1].endswith("(2 images)")
    with (tmp_path / "out" / "ground_truth.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert list(rows[0]) == ["image", "source", "illumination", "r", "g", "b"]
    assert [row["image"] for row in rows] == [f"{number:06d}.png" for number in NUMBERS]
    assert [row["source"] for row in rows] == [
        name for name in ("a.png", "b, c.png", "more/d.png", "more/e.png") for _ in range(2)
    ]
    assert [int(row["illumination"]) for row in rows] == [2, 1] * 4
    truths = [[float(row[channel]) for channel in "rgb"] for row in rows]
    np.testing.assert_allclose(truths, lut.ground_truth[[2, 1] * 4], atol=1e-9)
    np.testing.assert_allclose(np.sum(truths, axis=1), 1, atol=2e-9)
    np.testing.assert_array_equal(np.loadtxt(tmp_path / "out" / "gt.txt"), truths)
    named = np.loadtxt(tmp_path / "out" / "named_gt.txt", dtype=str)
    np.testing.assert_array_equal(named[:, 1:].astype(float), truths)
    assert all((tmp_path / "out" / "images" / name).is_file() for name in named[:, 0])
    described = json.loads((tmp_path / "out" / "dataset.json").read_text())
    assert (described["format"], described["version"], described["seed"]) == ("crop.dataset", 2, 77)
    assert described["table"]["sha256"] == lut.sha256
    assert described["table"]["white_level"] == 8000
    assert (described["planned"], described["images"], described["sources"]) == (10, 8, 4)
    assert described["skipped"] == [{"position": 2, "name": "broken.jpg"}]
    with (tmp_path / "out" / "sources.csv").open(newline="") as stream:
        sources = list(csv.DictReader(stream))
    assert [(row["position"], row["name"]) for row in sources] == [
        ("0", "a.png"),
        ("1", "b, c.png"),
        ("3", "more/d.png"),
        ("4", "more/e.png"),
    ]
    file = pictures / "b, c.png"
    assert sources[1]["sha256"] == hashlib.sha256(file.read_bytes()).hexdigest()
    assert (sources[1]["width"], sources[1]["height"]) == ("17", "31")
    assert str(tmp_path) not in (tmp_path / "out" / "dataset.json").read_text()
    lines = (tmp_path / "out" / "SHA256SUMS").read_text().splitlines()
    hashes = {name: digest for digest, name in (line.split("  ") for line in lines)}
    unlisted = {"SHA256SUMS", "README.md", "DATASHEET.md"}
    assert hashes == {name: digest for name, digest in contents(tmp_path / "out").items() if name not in unlisted}
    # Every image agrees with its number, source and illuminant, for our reader and for OpenCV.
    reopened = open_dataset(tmp_path / "out")
    assert reopened == data_set
    for number, entry in zip(NUMBERS, reopened.entries, strict=True):
        expected = render(lut, read_picture(pictures / entry.source), int(entry.illumination), seed=77, image=number)
        np.testing.assert_array_equal(reopened.read_image(entry), expected)
        path = tmp_path / "out" / "images" / entry.image
        stored = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert stored is not None
        np.testing.assert_array_equal(stored[..., ::-1], expected)
        data = reopened.read_preview(entry)
        assert data is not None
        preview = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        assert preview is not None
        factor = -(-max(expected.shape[:2]) // 400)
        assert max(preview.shape[:2]) == -(-max(expected.shape[:2]) // factor)


@pytest.mark.slow
def test_bytes_do_not_depend_on_workers(make_lut: MakeLut, pictures: Path, tmp_path: Path) -> None:
    lut = make_lut(unfit=(3,))
    sources = (*find_pictures([pictures]), *random_scenes(3, 40, 30, 5))
    for workers in (1, 7):
        choice = RandomLights(3, 4, 5)
        generate_dataset(lut, tmp_path / f"out{workers}", sources, choice, seed=5, workers=workers)
    assert contents(tmp_path / "out1") == contents(tmp_path / "out7")
    generate_dataset(lut, tmp_path / "other", sources, RandomLights(3, 4, 5), seed=6)
    first, second = contents(tmp_path / "out1"), contents(tmp_path / "other")
    assert all(first[name] != second[name] for name in first if name.startswith("images/"))


@pytest.mark.slow
def test_counts_replaced_pixels(make_lut: MakeLut, pictures: Path, tmp_path: Path) -> None:
    lut = make_lut(unfit=(0, 21))
    (source,) = find_pictures([pictures / "a.png"])
    data_set = generate_dataset(
        lut, tmp_path / "out", [source], [0], options=DatasetOptions(previews=False, rendering="codes")
    )
    top = source.read().picture >> 6
    count = int(((top == 0).all(axis=2) | (top == 1).all(axis=2)).sum())  # colour 21 is (1, 1, 1)
    assert count > 0
    assert data_set.description.replaced_pixels == count
    assert data_set.description.pixels == top.size // 3
    assert [source.replaced_pixels for source in data_set.sources] == [count]
    assert data_set.read_preview(data_set.entries[0]) is None
    assert not (tmp_path / "out" / "previews").exists()


@pytest.mark.slow
def test_refuses_changed_samples(make_lut: MakeLut, pictures: Path, tmp_path: Path) -> None:
    lut = make_lut()
    with (lut.folder / "samples.npy").open("r+b") as stream:
        stream.seek(-1, os.SEEK_END)
        stream.write(b"\xff")
    sources = find_pictures([pictures])
    by_codes = DatasetOptions(rendering="codes")
    generate_dataset(lut, tmp_path / "sound", sources, [0, 1], options=by_codes)
    with pytest.raises(FormatError, match="illuminant 3"):
        generate_dataset(lut, tmp_path / "out", sources, [0, 3], options=by_codes)
    with pytest.raises(FormatError, match="illuminant 3"):
        generate_dataset(lut, tmp_path / "mixed", sources, ListedLights((mixture_of({0: 1, 3: 1}),)), options=by_codes)
    # For colorimetric rendering, the map of the print may use any illuminant.
    with pytest.raises(FormatError, match="illuminant 3"):
        generate_dataset(lut, tmp_path / "by-colour", sources, [3])


@pytest.mark.slow
def test_skips_pictures_too_small_for_format(make_lut: MakeLut, tmp_path: Path) -> None:
    sources = (*random_scenes(1, 21, 40), *random_scenes(1, 22, 22, 5))
    skipped: list[str] = []
    data_set = generate_dataset(
        make_lut(),
        tmp_path / "out",
        sources,
        [0],
        options=DatasetOptions(form="dng"),
        callbacks=Callbacks(on_skip=lambda name, reason, missed: skipped.append(reason)),
    )
    assert [entry.image for entry in data_set.entries] == ["000001.dng"]
    (reason,) = skipped
    assert reason.startswith("random-000000 is 21x40 px, expected 22x22 or more for dng; choose another")


@pytest.mark.slow
def test_failed_data_set_leaves_no_files(make_lut: MakeLut, pictures: Path, tmp_path: Path) -> None:
    lut = make_lut()
    sources = find_pictures([pictures])
    original, threads = contents(tmp_path), threading.active_count()
    with pytest.raises(InputError, match="there is no illuminant 9"):
        generate_dataset(lut, tmp_path / "out", sources, [0, 9], workers=2)
    with pytest.raises(FormatError, match="0 of 1 pictures"):
        generate_dataset(lut, tmp_path / "out", find_pictures([pictures / "broken.jpg"]), [0])
    invalid_split: Any = (1, 2)
    with pytest.raises(InputError, match=r"split is 1,2, .*sum 1"):
        generate_dataset(lut, tmp_path / "out", sources, [0], options=DatasetOptions(split=invalid_split))
    with pytest.raises(InputError, match="'bmp'"):
        DatasetOptions(form=cast("Any", "bmp"))
    assert contents(tmp_path) == original
    assert not list(tmp_path.glob(".out*"))
    assert threading.active_count() == threads


@pytest.mark.slow
def test_refuses_existing_folder_and_empty_lists(make_lut: MakeLut, pictures: Path, tmp_path: Path) -> None:
    lut = make_lut()
    with pytest.raises(InputError):
        generate_dataset(lut, pictures, find_pictures([pictures]), [0])
    with pytest.raises(InputError, match="0 pictures and 1 illuminants"):
        generate_dataset(lut, tmp_path / "out", [], [0])
    with pytest.raises(InputError):
        generate_dataset(lut, tmp_path / "out", find_pictures([pictures]), [])
    with pytest.raises(InputError):
        generate_dataset(lut, tmp_path / "out", find_pictures([pictures]), [0], workers=0)


@pytest.fixture
def lut(make_lut: MakeLut, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Lut:
    """Return a LUT of 512 colours, and change to its folder with six pictures."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pictures").mkdir()
    for number in range(6):
        codes = np.random.default_rng(number).integers(0, 256, (24, 30 + number, 3)).astype(np.uint8)
        cv2.imwrite(f"pictures/{number}.png", codes)
    return make_lut(bits=3)


class TestRepeatedCommand:
    OPTIONS = ("--sources", "pictures", "--seed", "2", "--rendering", "codes")

    @pytest.mark.slow
    def test_changes_nothing(self, lut: Lut, capsys: pytest.CaptureFixture[str]) -> None:
        options = (*self.OPTIONS, "--contact-sheet", "sheet.png")
        assert main(("lut", "out", *options)) == 0
        original_times = {path: path.stat().st_mtime_ns for path in Path("out").rglob("*")}
        capsys.readouterr()
        assert main(("lut", "out", *options)) == 0
        printed = capsys.readouterr().out
        assert "out: 6 images of 6 pictures under" in printed
        assert "it was already complete" in printed
        assert "sheet.png: the contact sheet already exists" in printed
        assert {path: path.stat().st_mtime_ns for path in Path("out").rglob("*")} == original_times

    @pytest.mark.slow
    def test_reports_changed_pictures(self, lut: Lut, capsys: pytest.CaptureFixture[str]) -> None:
        # The time stamps of copied files must not matter.
        assert main(("lut", "out", *self.OPTIONS)) == 0
        os.utime("out/dataset.json", (1_000_000_000, 1_000_000_000))
        assert main(("lut", "out", *self.OPTIONS)) == 0, "new time stamp, but equal content"
        data = Path("pictures/4.png").read_bytes()
        shutil.copy("pictures/5.png", "pictures/4.png")
        os.utime("pictures/4.png", (900_000_000, 900_000_000))
        assert main(("lut", "out", *self.OPTIONS)) == 2
        assert "different data set (the content of 4.png)" in capsys.readouterr().err
        Path("pictures/4.png").write_bytes(data)
        assert main(("lut", "out", *self.OPTIONS)) == 0
        Path("pictures/4.png").rename("pictures/9.png")
        assert main(("lut", "out", *self.OPTIONS)) == 2
        assert "source 4 4.png, now 5.png" in capsys.readouterr().err

    def test_refuses_other_folder(self, lut: Lut, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(("lut", "pictures", "--sources", "pictures")) == 2
        assert "pictures already exists" in capsys.readouterr().err

    @pytest.mark.slow
    def test_refuses_other_lut(self, lut: Lut, make_lut: MakeLut, capsys: pytest.CaptureFixture[str]) -> None:
        data_set: Dataset = generate_dataset(lut, "out", find_pictures("pictures"), [0])
        assert data_set.description.images == 6
        make_lut(bits=2, name="other")
        assert open_lut("other").sha256 != lut.sha256
        assert main(("other", "out", "--sources", "pictures", "--light", "0")) == 2
        assert "table sha256" in capsys.readouterr().err


IMAGES = 48

SHARD = 8


def make_data_set(lut: Lut, out: Path, engine: str, workers: int, callbacks: Callbacks = SILENT) -> None:
    scenes = random_scenes(IMAGES // 2, 24, 16, 4)
    lights = RandomLights(2, 4, 4)
    generate_dataset(
        lut,
        out,
        scenes,
        lights,
        seed=4,
        options=DatasetOptions(previews=False, rendering="codes", shard_images=SHARD, split=(0.8, 0.1, 0.1)),
        workers=Workers(engine, workers),
        callbacks=callbacks,
    )


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Lut, dict[str, str]]:
    """Return a LUT, and the hashes of the files of a data set that one thread made."""
    folder = tmp_path_factory.mktemp("undisturbed")
    lut = lut_in(folder / "lut")
    make_data_set(lut, folder / "out", "local", 1)
    return lut, contents(folder / "out")


def dask_workers() -> list[psutil.Process]:
    """Return the processes of our Dask workers."""
    below = psutil.Process().children(recursive=True)
    # If setproctitle is installed, Dask replaces the command by a title.
    titles = ("spawn_main", "dask")
    return [process for process in below if any(title in " ".join(process.cmdline()).lower() for title in titles)]


@pytest.mark.slow
def test_killed_worker_changes_no_byte(undisturbed: tuple[Lut, dict[str, str]], tmp_path: Path) -> None:
    lut, expected = undisturbed
    killed: list[int] = []

    def kill_one() -> None:
        if not killed:
            victim = dask_workers()[0]
            victim.kill()
            killed.append(victim.pid)

    # It is the only worker; Dask starts another one for the rest.
    make_data_set(lut, tmp_path / "out", "dask", 1, Callbacks(on_image=kill_one))
    assert len(killed) == 1
    assert contents(tmp_path / "out") == expected
    assert not list(tmp_path.glob(".out*"))


@pytest.mark.slow
def test_existing_dask_cluster(
    undisturbed: tuple[Lut, dict[str, str]],
    make_lut: MakeLut,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from distributed import LocalCluster

    lut, expected = undisturbed
    counted = iter(range(SHARD + 3))

    def stop() -> None:
        if next(counted, None) is None:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make_data_set(lut, tmp_path / "out", "local", 1, Callbacks(on_image=stop))
    with LocalCluster(
        n_workers=0,
        threads_per_worker=2,
        host="127.0.0.1",
        dashboard_address="127.0.0.1:0",
        memory_limit=None,
        silence_logs=logging.CRITICAL,
    ) as cluster:
        address = cluster.scheduler_address.replace("tcp://", "dask://")
        messages: list[str] = []
        reused: list[int] = []
        reported: list[None] = []

        def start_one(sentence: str) -> None:
            messages.append(sentence)
            cluster.scale(1)

        callbacks = Callbacks(on_done=reused.append, on_image=lambda: reported.append(None), on_wait=start_one)
        make_data_set(lut, tmp_path / "out", address, 1, callbacks)
        assert contents(tmp_path / "out") == expected
        assert sum(reused) > SHARD, "images of the incomplete shard are not reused"
        assert sum(reused) + len(reported) == IMAGES
        hint = f"the Dask scheduler has 0 workers, expected 1 or more; run dask worker {cluster.scheduler_address}"
        assert messages == [hint]
        # A worker refuses a different LUT at the same path.
        other_lut = make_lut(name="other")
        assert other_lut.sha256, "hash before the change"
        shutil.rmtree(other_lut.folder)
        make_lut(name="other", unfit=(3,))
        with pytest.raises(InputError):
            generate_dataset(other_lut, tmp_path / "refused", random_scenes(2, 24, 16), [0], workers=Workers(address))
        # The worker was started in another folder.
        monkeypatch.chdir(tmp_path)
        Path("pictures").mkdir()
        Path("pictures/a.pgm").write_bytes(b"P5 2 2 255 abcd")
        data_set = generate_dataset(lut, Path("relative"), find_pictures(["pictures"]), [0], workers=Workers(address))
        assert data_set.description.images == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "address"), [("local", None), ("dask", ""), ("dask://node7:8786", "tcp://node7:8786")]
)
def test_parses_engines(name: str, address: str | None) -> None:
    assert parse_engine(name) == address


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ray", "dask://", "dask://node7", "tcp://node7:8786", ""])
def test_refuses_unknown_engine(name: str) -> None:
    with pytest.raises(InputError, match="dask://HOST:PORT"):
        parse_engine(name)


@pytest.mark.slow
def test_reports_unreachable_scheduler(make_lut: MakeLut, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("generator.dataset.making.CONNECT_S", 0.2)
    with pytest.raises(InputError, match=r"127\.0\.0\.1:1"):
        generate_dataset(
            make_lut(), tmp_path / "out", random_scenes(2, 24, 16), [0], workers=Workers("dask://127.0.0.1:1")
        )
    assert [path.name for path in tmp_path.iterdir()] == ["lut"]
