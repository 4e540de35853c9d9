"""A dataset that was interrupted, killed or disturbed is gone on with, and ends in the bytes of an undisturbed one."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import cv2
import numpy as np
import pytest

from foundation.errors import FormatError, InputError
from foundation.folders import FolderLock, held_folder
from generator.dataset import layouts as plain_files
from generator.dataset import shards
from generator.dataset.making import Workers, generate_dataset, make_dataset, make_share, workplace
from generator.dataset.plan import DatasetOptions, Plan
from generator.dataset.reader import Dataset, open_dataset
from generator.dataset.records import FinishedImage, Layout, ShardRecord
from generator.dataset.shards import SILENT, Callbacks, Workplace
from generator.lights.choices import SimultaneousLights
from generator.lights.lighting import ListedLights, RandomLights
from generator.masks.making import parse_masks
from generator.pictures.random_scenes import random_scenes
from generator.pictures.sources import Source, find_pictures
from generator.rendering.black_points import BlackPoint
from tests.generator.conftest import MakeLut, lut_in
from tests.generator.dataset.contents import contents
from tests.generator.groups import grouped

pytestmark = pytest.mark.slow

if TYPE_CHECKING:
    from calibration.table.lut import Lut

SCENES = random_scenes(4, 24, 16, 8)


def make(lut: Lut, out: Path, scenes: int = 4, **options: Any) -> Dataset:
    wishes: dict[str, Any] = {"seed": 3, "shard_images": 2, "split": (0.5, 0.0, 0.5), "previews": False}
    wishes["rendering"] = "codes"
    return generate_dataset(lut, out, SCENES[:scenes], [2, 0], **grouped(**(wishes | options)))


class StopIt(Exception):
    """An interruption from a callback."""


def interrupt_after(images: int) -> Callable[[], None]:
    counted = iter(range(images))

    def on_image() -> None:
        if next(counted, None) is None:
            raise StopIt

    return on_image


@pytest.mark.parametrize(("layout", "workers"), [("folder", 3), *((layout, 1) for layout in get_args(Layout))])
def test_going_on_gives_the_same_bytes(make_lut: MakeLut, tmp_path: Path, layout: str, workers: int) -> None:
    lut = make_lut()
    make(lut, tmp_path / "whole", layout=layout)
    with pytest.raises(StopIt):
        make(lut, tmp_path / "out", layout=layout, workers=workers, on_image=interrupt_after(4))
    assert not (tmp_path / "out").exists()
    assert len(list((tmp_path / ".out.partial" / "plan" / "shards").iterdir())) in (1, 2, 3, 4)
    count: list[None] = []
    make(lut, tmp_path / "out", layout=layout, workers=workers, on_image=lambda: count.append(None))
    assert len(count) < 8, "what was done is not done again"
    assert contents(tmp_path / "out") == contents(tmp_path / "whole")
    assert not list(tmp_path.glob(".out*"))


Made = tuple[int, int, list[int]]
"""Images that were found finished, images that were reported one by one, and the numbers of those rendered."""


def made_after(monkeypatch: pytest.MonkeyPatch, call: Callable[[Callbacks], object]) -> Made:
    """Call something that makes images, and return what it did."""
    found: list[int] = []
    reported: list[None] = []
    rendered: list[int] = []
    photograph = shards.photograph

    def noted(*arguments: Any) -> Any:
        rendered.append(arguments[5])
        return photograph(*arguments)

    with monkeypatch.context() as patched:
        patched.setattr(shards, "photograph", noted)
        call(Callbacks(on_done=found.append, on_image=lambda: reported.append(None)))
    return sum(found), len(reported), sorted(rendered)


def killed_after(images: int, action: Callable[[], object]) -> None:
    """Call something that makes images in a process that is killed as soon as so many are finished."""
    child = os.fork()
    if not child:
        counted = iter(range(images - 1))
        note = Workplace.note

        def noted(self: Workplace, shard: int, image: FinishedImage) -> None:
            note(self, shard, image)
            if next(counted, None) is None:
                os.kill(os.getpid(), signal.SIGKILL)

        Workplace.note = noted  # pyrefly: ignore[method-assign]
        try:
            action()
        finally:
            os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL


def one_shard(
    lut: Lut,
    out: Path,
    callbacks: Callbacks = SILENT,
    workers: Workers | None = None,
    sources: Sequence[Source] = SCENES,
) -> Dataset:
    """Make eight images under two lights each, with previews, masks and what was done to each, in one shard."""
    choice = SimultaneousLights(ListedLights((2, 0, 1, 3)), 2, parse_masks("half-plane", 2, 5))
    options = DatasetOptions(rendering="codes", black_point=BlackPoint("random"), split=(0.5, 0.0, 0.5))
    plan = Plan(lut, sources, choice, 3, options)
    return make_dataset(plan, out, workers, callbacks)


def noted_images(out: Path) -> list[int]:
    """Return the numbers of the images that whole lines are there of."""
    lines = filter(None, notes_of(out).read_bytes().splitlines())
    return [int(line.split(b"\t")[1]) for line in lines if line.endswith(b"}")]


def notes_of(out: Path) -> Path:
    (notes,) = (out.with_name(f".{out.name}.partial") / "plan" / "shards").iterdir()
    return notes


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Lut, dict[str, str]]:
    """Return a table, and the files that `one_shard` makes of it undisturbed."""
    folder = tmp_path_factory.mktemp("whole")
    lut = lut_in(folder / "lut")
    one_shard(lut, folder / "out")
    return lut, contents(folder / "out")


@pytest.mark.parametrize("count", [1, 3])
def test_finished_images_of_a_killed_shard_count(
    whole: tuple[Lut, dict[str, str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, count: int
) -> None:
    (lut, expected), out, workers = whole, tmp_path / "out", Workers(count=count)
    killed_after(3, lambda: one_shard(lut, out, workers=workers))
    noted = noted_images(out)
    assert 3 <= len(noted) < 8
    assert count > 1 or noted == [0, 1, 2]
    found, reported, rendered = made_after(monkeypatch, lambda seen: one_shard(lut, out, seen, workers))
    assert (found, reported) == (len(noted), 8 - len(noted))
    assert rendered == sorted(set(range(8)) - set(noted))
    assert contents(out) == expected
    assert not list(tmp_path.glob(".out*"))


def cut_file(files: Path, notes: Path) -> None:
    del notes
    image = files / "images" / "000001.png"
    image.write_bytes(image.read_bytes()[:-7])


def changed_mask(files: Path, notes: Path) -> None:
    del notes
    mask = files / "masks" / "000001_1.png"
    data = bytearray(mask.read_bytes())
    data[len(data) // 2] ^= 1
    mask.write_bytes(data)


def lost_preview(files: Path, notes: Path) -> None:
    del notes
    (files / "previews" / "000001.jpg").unlink()


def cut_line(files: Path, notes: Path) -> None:
    del files
    lines = notes.read_bytes().split(b"\n\n")
    lines[1] = lines[1][: len(lines[1]) // 2]
    notes.write_bytes(b"\n\n".join(lines))


def cut_end(files: Path, notes: Path) -> None:
    del files
    notes.write_bytes(notes.read_bytes()[:-30])


def other_truth(files: Path, notes: Path) -> None:
    del files
    text = notes.read_text()
    start = text.index('"truth":[', text.index('"number":1,'))
    notes.write_text(text[: start + 11] + ("1" if text[start + 11] != "1" else "2") + text[start + 12 :])


@pytest.mark.parametrize("disturb", [cut_file, changed_mask, lost_preview, cut_line, cut_end, other_truth])
def test_a_cut_or_changed_image_is_made_again(
    whole: tuple[Lut, dict[str, str]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    disturb: Callable[[Path, Path], None],
) -> None:
    (lut, expected), out = whole, tmp_path / "out"
    killed_after(3, lambda: one_shard(lut, out))
    (files,) = (tmp_path / ".out.partial").glob("dataset-*")
    disturb(files, notes_of(out))
    # Killed once more, so that lines follow one that was cut.
    killed_after(1, lambda: one_shard(lut, out))
    assert noted_images(out)[-1] == (2 if disturb is cut_end else 1)
    assert made_after(monkeypatch, lambda seen: one_shard(lut, out, seen)) == (3, 5, [3, 4, 5, 6, 7])
    assert contents(out) == expected


def test_images_of_a_picture_that_changed_are_made_again(
    make_lut: MakeLut, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lut, out, folder = make_lut(), tmp_path / "out", tmp_path / "pictures"
    folder.mkdir()

    def draw(name: str, code: int) -> None:
        assert cv2.imwrite(str(folder / f"{name}.png"), np.full((16, 24, 3), code, np.uint8))

    for place, name in enumerate("abcd"):
        draw(name, 50 * place)
    sources = find_pictures(folder)
    killed_after(7, lambda: one_shard(lut, out, sources=sources))
    draw("a", 9)
    draw("d", 10)
    done = made_after(monkeypatch, lambda seen: one_shard(lut, out, seen, sources=sources))
    assert done == (4, 4, [0, 1, 6, 7]), "of d one image was finished"
    one_shard(lut, tmp_path / "whole", sources=sources)
    assert contents(out) == contents(tmp_path / "whole")


def test_images_of_a_picture_that_is_gone_do_not_count(
    make_lut: MakeLut, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lut, out, folder = make_lut(), tmp_path / "out", tmp_path / "pictures"
    folder.mkdir()
    for name in "abcd":
        assert cv2.imwrite(str(folder / f"{name}.png"), np.full((16, 24, 3), ord(name), np.uint8))
    sources = find_pictures(folder)
    killed_after(5, lambda: one_shard(lut, out, sources=sources))
    (folder / "a.png").unlink()
    done = made_after(monkeypatch, lambda seen: one_shard(lut, out, seen, sources=sources))
    assert done == (3, 3, [5, 6, 7])
    assert len(open_dataset(out).entries) == 6


def dies_at(step: int, below: Path, action: Callable[[], object]) -> bool:
    """Call `action` in a process that is killed right before its file operation number `step` below a folder.

    Returns whether it came that far.
    """
    child = os.fork()
    if not child:
        steps = 0
        mine = {"open", "os.rename", "os.mkdir", "os.remove", "os.rmdir"}

        def watch(event: str, arguments: tuple[Any, ...]) -> None:
            nonlocal steps
            if event in mine and str(arguments[0]).startswith(str(below)):
                steps += 1
                if steps == step:
                    os.kill(os.getpid(), signal.SIGKILL)

        sys.addaudithook(watch)
        try:
            action()
        finally:
            os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL


STRIDE = 7
"""Of a run's file operations every seventh is one that it is killed before: each takes two runs."""


def test_a_kill_at_any_file_operation_is_gone_on_from(make_lut: MakeLut, tmp_path: Path) -> None:
    lut = make_lut()
    make(lut, tmp_path / "whole", 1, shard_images=1)
    below = tmp_path / "below"
    step = 1 - STRIDE
    killed = True
    while killed:
        step += STRIDE
        below.mkdir()
        killed = dies_at(step, below, lambda: make(lut, below / "out", 1, shard_images=1))
        with contextlib.suppress(InputError):  # "already exists", where all that was left were empty folders
            make(lut, below / "out", 1, shard_images=1)
        assert contents(below / "out") == contents(tmp_path / "whole"), f"killed before file operation {step}"
        assert [path.name for path in below.iterdir()] == ["out"], f"killed before file operation {step}"
        shutil.rmtree(below)
    assert step > 40


@pytest.mark.parametrize(("layout", "begun"), [*((layout, False) for layout in get_args(Layout)), ("folder", True)])
def test_a_record_is_written_when_its_files_are_on_the_disk(
    make_lut: MakeLut, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, layout: str, begun: bool
) -> None:
    lut = make_lut()
    if begun:
        killed_after(3, lambda: make(lut, tmp_path / "out", layout=layout, shard_images=5))
    synced: set[int] = set()
    checked: list[str] = []
    fsync, commit = os.fsync, Workplace.commit

    def noted(handle: int) -> None:
        fsync(handle)
        synced.add(os.fstat(handle).st_ino)

    def checking(place: Workplace, record: ShardRecord) -> None:
        for file in record.files:
            path = Path(place.files.place) / file.name
            assert {path.stat().st_ino, path.parent.stat().st_ino} <= synced, f"{file.name} is only in memory"
            checked.append(file.name)
        commit(place, record)

    monkeypatch.setattr(plain_files, "_SYNCED_IMAGES", 2)
    monkeypatch.setattr(os, "fsync", noted)
    monkeypatch.setattr(Workplace, "commit", checking)
    make(lut, tmp_path / "out", layout=layout, workers=2, shard_images=5)
    assert len(checked) >= 2


def test_another_plan_in_the_same_place_is_refused(make_lut: MakeLut, tmp_path: Path) -> None:
    lut, out = make_lut(), tmp_path / "out"
    with pytest.raises(StopIt):
        make(lut, out, on_image=interrupt_after(4))
    with pytest.raises(InputError, match=r"\(seed 3, now 4\).*remove"):
        make(lut, out, seed=4)
    with pytest.raises(InputError, match=r"previews false, now true"):
        make(lut, out, previews=True)
    with pytest.raises(InputError, match=r"8.*6.*4.*3.*4.*3.*sha256"):
        make(lut, out, 3)
    other = make_lut(bits=3, name="other")
    with pytest.raises(InputError, match=r"sha256.*2.*3"):
        make(other, out)
    make(lut, out)


def test_one_program_makes_a_dataset_at_a_time(make_lut: MakeLut, tmp_path: Path) -> None:
    lut, out = make_lut(), tmp_path / "out"
    plan = Plan(lut, SCENES, ListedLights((0,)), 0, DatasetOptions())
    with (
        workplace(out, plan.identity()),
        pytest.raises(InputError, match="another program"),
    ):
        generate_dataset(lut, out, SCENES, [0])


def plan_of(lut: Lut) -> Plan:
    return Plan(
        lut, SCENES, RandomLights(3, 4, 9), 9, DatasetOptions(rendering="codes", shard_images=2, split=(0.4, 0.3, 0.3))
    )


def test_shares_make_the_whole(make_lut: MakeLut, tmp_path: Path) -> None:
    lut, out = make_lut(), tmp_path / "out"
    make_dataset(plan_of(lut), tmp_path / "whole")
    assert make_share(plan_of(lut), out, (1, 3), Workers(count=2)) == (2, 6)
    assert make_share(plan_of(lut), out, (0, 3)) == (4, 6)
    with pytest.raises(InputError, match=r"share 3 of 3.*0 to 2"):
        make_share(plan_of(lut), out, (3, 3))
    assert make_share(plan_of(lut), out, (2, 3)) == (6, 6)
    assert make_share(plan_of(lut), out, (2, 3)) == (6, 6), "made again, nothing changes"
    assert not out.exists()
    make_dataset(plan_of(lut), out)
    assert contents(out) == contents(tmp_path / "whole")
    assert not list(tmp_path.glob(".out*"))


def test_shares_are_made_beside_each_other(make_lut: MakeLut, tmp_path: Path) -> None:
    lut = make_lut()
    with workplace(tmp_path / "out", plan_of(lut).identity(), alone=False):
        assert make_share(plan_of(lut), tmp_path / "out", (0, 1)) == (6, 6)
        with pytest.raises(InputError, match="another program"):
            make_dataset(plan_of(lut), tmp_path / "out")


def test_a_share_that_waited_for_the_whole_is_refused(
    make_lut: MakeLut, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its work could never become a dataset, and would stay under the hidden name."""
    lut, out = make_lut(), tmp_path / "out"
    make_dataset(plan_of(lut), tmp_path / "whole")

    def finished_meanwhile(*arguments: Any, **named: Any) -> contextlib.AbstractContextManager[FolderLock]:
        (tmp_path / "whole").rename(out)
        return held_folder(*arguments, **named)

    monkeypatch.setattr("generator.dataset.making.held_folder", finished_meanwhile)
    with pytest.raises(InputError, match="already exists"):
        make_share(plan_of(lut), out, (0, 2))
    assert not (tmp_path / ".out.partial").exists()


@pytest.mark.parametrize(("old", "new"), [("24", "25"), ("}\n", "\n"), ("shard\t", "")])
def test_a_shard_of_a_damaged_record_is_made_again(
    make_lut: MakeLut, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, old: str, new: str
) -> None:
    lut, out = make_lut(), tmp_path / "out"
    make_share(plan_of(lut), out, (0, 1))
    (record,) = (tmp_path / ".out.partial" / "plan" / "shards").glob("000001.*")
    record.write_text(record.read_text().replace(old, new))
    done = made_after(monkeypatch, lambda seen: make_dataset(plan_of(lut), out, callbacks=seen))
    assert done == (10, 2, [2, 3])
    make_dataset(plan_of(lut), tmp_path / "whole")
    assert contents(out) == contents(tmp_path / "whole")


def test_a_picture_that_changed_between_two_shares_is_reported(make_lut: MakeLut, tmp_path: Path) -> None:
    lut, out, folder = make_lut(), tmp_path / "out", tmp_path / "pictures"
    folder.mkdir()
    cv2.imwrite(str(folder / "a.png"), np.full((16, 24, 3), 50, np.uint8))
    plan = Plan(lut, find_pictures(folder), RandomLights(3, 4, 9), 9, DatasetOptions(shard_images=2))
    make_share(plan, out, (0, 2))
    cv2.imwrite(str(folder / "a.png"), np.full((16, 24, 3), 60, np.uint8))
    with pytest.raises(FormatError, match=r"a\.png changed"):
        make_dataset(plan, out)
