"""Where pictures come from: folders in the order of their names, stores, and random codes."""

from __future__ import annotations

import errno
import hashlib
import itertools
import os
import sys
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from foundation.errors import FormatError, InputError, StorageError
from generator.pictures import sources as scene
from generator.pictures.random_scenes import RandomScene, random_scenes
from generator.pictures.sources import PictureFile, Preparation, find_pictures
from generator.stores import filesystem
from tests.generator.pictures.oiio_files import write


def test_folders_are_searched_in_order_of_names(tmp_path: Path) -> None:
    names = ("b.png", "a/z.JPG", "a.tif", "a-b/y.png", "B.png", "notes.txt", ".hidden.png", ".cache/c.png", "a/b/c.exr")
    for name in names:
        (tmp_path / "in" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "in" / name).touch()
    (tmp_path / "alone.dat").touch()
    found = find_pictures([tmp_path / "alone.dat", str(tmp_path / "in")], Preparation(max_side=99))
    assert [source.name for source in found] == [
        *("alone.dat", "B.png", "a-b/y.png", "a.tif", "a/b/c.exr", "a/z.JPG", "b.png")
    ]
    assert [source.location for source in found[2:4]] == [str(tmp_path / "in/a-b/y.png"), str(tmp_path / "in/a.tif")]
    assert {source.preparation.max_side for source in found} == {99}


def test_links_are_followed_unless_that_is_searched_already(tmp_path: Path) -> None:
    """Neither circles nor pictures that come twice, whatever leads to what."""
    (tmp_path / "in/deep").mkdir(parents=True)
    (tmp_path / "in/deep/a.png").touch()
    (tmp_path / "out/far").mkdir(parents=True)
    (tmp_path / "out/far/c.png").touch()
    (tmp_path / "in/again").symlink_to(tmp_path / "in")
    (tmp_path / "in/above").symlink_to(tmp_path)
    (tmp_path / "in/b.png").symlink_to(tmp_path / "in/deep/a.png")
    (tmp_path / "in/elsewhere").symlink_to(tmp_path / "out")
    (tmp_path / "in/further").symlink_to(tmp_path / "out/far")
    (tmp_path / "out/back").symlink_to(tmp_path / "in/deep")
    (tmp_path / "in/nowhere").symlink_to(tmp_path / "gone")
    (tmp_path / "in/round").symlink_to(tmp_path / "in/round")
    found = find_pictures([tmp_path / "in"])
    assert [source.name for source in found] == ["b.png", "deep/a.png", "elsewhere/far/c.png"]
    (tmp_path / "whole").symlink_to(tmp_path / "in")
    assert len(find_pictures([tmp_path / "whole"])) == 3, "a folder that is named may be a link itself"


def test_what_is_not_read_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for name in ("a.png", "IMG_1.HEIC", "deep/IMG_2.heif"):
        (tmp_path / "in" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "in" / name).touch()
    assert [source.name for source in find_pictures([tmp_path / "in"])] == ["a.png"]
    (told,) = caplog.messages
    assert told.startswith(f"{tmp_path}/in holds IMG_1.HEIC and 1 more, which are left out: HEIC and AVIF are not")
    assert [source.name for source in find_pictures(f"file://{tmp_path}/in")] == ["a.png"]
    assert len(caplog.messages) == 2
    (tmp_path / "in/a.png").unlink()
    with pytest.raises(InputError, match=r"IMG_1\.HEIC and 1 more"):
        find_pictures([tmp_path / "in"])
    (tmp_path / "in/deep/IMG_2.heif").unlink()
    with pytest.raises(InputError, match=r"IMG_1\.HEIC, which"):
        find_pictures([tmp_path / "in"])


@pytest.mark.skipif(sys.platform != "linux", reason="names are bytes, whatever they mean, on Linux only")
def test_names_that_are_no_text_are_read_and_shown_as_escapes(tmp_path: Path, colours: npt.NDArray[np.uint8]) -> None:
    folder = tmp_path / os.fsdecode(b"folder \xe9")
    folder.mkdir()
    data = cv2.imencode(".png", colours[..., ::-1])[1].tobytes()
    (folder / os.fsdecode(b"picture \xff.png")).write_bytes(data)
    (folder / os.fsdecode(b"damaged \xff.png")).write_bytes(data[:60])
    damaged, whole = find_pictures([folder])
    assert (damaged.name, whole.name) == ("damaged \\xff.png", "picture \\xff.png")
    np.testing.assert_array_equal(whole.read().picture, colours)
    with pytest.raises(FormatError, match="damaged"):
        damaged.read()


def test_no_two_files_have_one_name() -> None:
    """Bytes that are no text, what reads like them, and backslashes before either."""
    parts = [b"\xff", rb"\xff", rb"\\xff", rb"\\\xff", b"\\\xff", b"\\\\\xff", rb"\x7f", b"x", b"\\"]
    paths = {b"".join(some) for count in range(1, 4) for some in itertools.product(parts, repeat=count)}
    names = {PictureFile("folder", os.fsdecode(path)).name for path in paths}
    assert len(names) == len(paths) > 500
    assert PictureFile("folder", r"a\b\x7f.png").name == r"a\b\x7f.png"


@pytest.mark.parametrize("url", [False, True])
def test_datasets_among_the_pictures_are_no_sources(tmp_path: Path, colours: npt.NDArray[np.uint8], url: bool) -> None:
    for name in ("a.png", "made/images/000000.png", "made/previews/000000.jpg", "more/b.png"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        write(tmp_path / name, colours, "uint8")
    (tmp_path / "made" / "dataset.json").write_text("{}")
    place = str(tmp_path)
    if url:
        place = f"memory://{tmp_path.name}"
        store, top = filesystem(place)
        for path in tmp_path.rglob("*.*"):
            store.pipe_file(f"{top}/{path.relative_to(tmp_path).as_posix()}", path.read_bytes())
    assert [found.name for found in find_pictures([place])] == ["a.png", "more/b.png"]
    # Who names it wants it.
    named = find_pictures(f"{place}/made")
    assert [found.name for found in named] == ["images/000000.png", "previews/000000.jpg"]


def test_two_pictures_of_one_name_are_refused(tmp_path: Path, colours: npt.NDArray[np.uint8]) -> None:
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        write(tmp_path / folder / "a.png", colours, "uint8")
    with pytest.raises(InputError, match=r"called a\.png: .*one/a\.png and .*two/a\.png"):
        find_pictures([tmp_path / "one", tmp_path / "two"])
    with pytest.raises(InputError, match=r"one/a\.png is named twice"):
        find_pictures([tmp_path / "one", tmp_path / "one"])
    assert [found.name for found in find_pictures(tmp_path)] == ["one/a.png", "two/a.png"]


def test_a_name_is_one_line_of_a_list(tmp_path: Path, colours: npt.NDArray[np.uint8]) -> None:
    write(tmp_path / "a.png", colours, "uint8").rename(tmp_path / "a\rb.png")
    assert find_pictures([tmp_path])[0].name == "a\\rb.png"


def test_a_picture_that_memory_does_not_hold_is_named(
    tmp_path: Path, colours: npt.NDArray[np.uint8], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path / "large.png", colours, "uint8")

    def full(*arguments: object) -> None:
        raise MemoryError

    monkeypatch.setattr(scene, "open_picture", full)
    with pytest.raises(InputError, match=r"large\.png.*workers"):
        find_pictures(path)[0].read()


@pytest.mark.parametrize("name", ["a.jpg", "a.png"])
def test_a_file_of_any_size_is_read_and_hashed_alike(
    tmp_path: Path, colours: npt.NDArray[np.uint8], monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    source = find_pictures(write(tmp_path / name, colours, "uint8"))[0]
    at_once = source.read()
    monkeypatch.setattr(scene, "_KEPT", 10)
    in_pieces = source.read()
    assert at_once.sha256 == in_pieces.sha256 == hashlib.sha256((tmp_path / name).read_bytes()).hexdigest()
    np.testing.assert_array_equal(at_once.picture, in_pieces.picture)


def test_links_that_lead_round_in_a_circle_are_passed_over(tmp_path: Path, colours: npt.NDArray[np.uint8]) -> None:
    write(tmp_path / "picture.png", colours, "uint8")
    (tmp_path / "a.png").symlink_to(tmp_path / "b.png")
    (tmp_path / "b.png").symlink_to(tmp_path / "a.png")
    assert [found.name for found in find_pictures([tmp_path])] == ["picture.png"]


@pytest.mark.parametrize(
    ("number", "kind"),
    [(errno.EACCES, FormatError), (errno.EIO, FormatError), (errno.EMFILE, StorageError), (errno.ESTALE, StorageError)],
)
def test_faults_of_a_file_and_of_the_machine_are_distinguished(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, kind: type[Exception]
) -> None:
    (tmp_path / "a.png").write_bytes(b"any")
    (source,) = find_pictures([tmp_path])

    def fail(*_: object, **__: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(Path, "open", fail)
    with pytest.raises(kind, match=rf"cannot read .*a\.png: {os.strerror(number)};"):
        source.read()


def test_pictures_of_a_store_are_those_of_a_folder(tmp_path: Path, colours: npt.NDArray[np.uint8]) -> None:
    store, root = filesystem(f"memory://{tmp_path.name}")
    local: list[Path] = []
    for name in ("b.png", "in/a.png", ".hidden.png", "notes.txt"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        local.append(write(tmp_path / f"{name}.png", colours, "uint8"))
        store.pipe_file(f"{root}/{name}", local[-1].read_bytes())
    found = find_pictures([f"memory://{tmp_path.name}"])
    assert [source.name for source in found] == ["b.png", "in/a.png"]
    for source in found:
        scene = source.read()
        np.testing.assert_array_equal(scene.picture, colours)
        assert scene.sha256 == hashlib.sha256(local[0].read_bytes()).hexdigest()
    (alone,) = find_pictures([f"memory://{tmp_path.name}/b.png"])
    assert alone.name == "b.png"
    np.testing.assert_array_equal(alone.read().picture, colours)
    store.rm(f"{root}/b.png")
    with pytest.raises(FormatError, match=r"cannot read memory://.*b\.png"):
        alone.read()
    with pytest.raises(InputError, match="holds no picture"):
        find_pictures([f"memory://{tmp_path.name}/nothing"])
    with pytest.raises(InputError, match="cannot reach nostore://"):
        find_pictures(["nostore://a/b"])


def test_places_without_pictures_are_named(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="empty holds no picture"):
        find_pictures([tmp_path / "empty"])
    with pytest.raises(InputError, match=r"there is no .*nowhere"):
        find_pictures([tmp_path / "nowhere"])


@pytest.mark.slow
def test_random_scenes_are_uniform_and_their_own() -> None:
    first, second = (scene.read().picture for scene in random_scenes(2, 1001, 800, seed=9))
    assert first.shape == (800, 1001, 3)
    # Chi-square with 255 degrees of freedom exceeds 370 once in a million; the seed is fixed.
    for channel in range(3):
        counts = np.bincount(first[..., channel].ravel(), minlength=256)
        expected = first[..., channel].size / 256
        assert ((counts - expected) ** 2 / expected).sum() < 370
    assert abs(np.corrcoef(first.ravel(), second.ravel())[0, 1]) < 0.005
    assert abs(np.corrcoef(first[..., 0].ravel(), first[..., 1].ravel())[0, 1]) < 0.007
    np.testing.assert_array_equal(RandomScene(1, 500, 30, 9).read().picture, second[:30, :500])
