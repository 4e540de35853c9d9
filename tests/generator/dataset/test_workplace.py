"""A dataset that was interrupted, killed or disturbed is gone on with, and ends in the bytes of an undisturbed one."""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import pytest

from foundation.errors import FormatError, InputError
from foundation.folders import FolderLock, held_folder
from generator.dataset import layouts as plain_files
from generator.dataset.making import (
    DatasetOptions,
    Plan,
    Workers,
    finish_dataset,
    generate_dataset,
    make_dataset,
    make_share,
)
from generator.dataset.reader import Dataset
from generator.dataset.records import Layout, ShardRecord
from generator.dataset.workplace import Workplace, workplace
from generator.lights.choices import ListedLights, RandomLights
from generator.pictures.sources import random_scenes
from tests.generator.groups import grouped

pytestmark = pytest.mark.slow

if TYPE_CHECKING:
    from calibration.table.lut import Lut

SCENES = random_scenes(4, 24, 16, 8)


def contents(folder: Path) -> dict[str, str]:
    """Return the hash of every file below `folder`."""
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in folder.rglob("*")
        if path.is_file()
    }


def make(lut: Lut, out: Path, scenes: int = 4, **options: Any) -> Dataset:
    wishes: dict[str, Any] = {"seed": 3, "shard_images": 2, "split": (0.5, 0.0, 0.5), "previews": False}
    return generate_dataset(lut, out, SCENES[:scenes], [2, 0], **grouped(**(wishes | options)))


class StopIt(Exception):
    """An interruption from a callback."""


def interrupt_after(images: int) -> Callable[[], None]:
    counted = iter(range(images))

    def on_image() -> None:
        if next(counted, None) is None:
            raise StopIt

    return on_image


@pytest.mark.parametrize("layout", get_args(Layout))
@pytest.mark.parametrize("workers", [1, 3])
def test_going_on_gives_the_same_bytes(make_lut: Callable[..., Lut], tmp_path: Path, layout: str, workers: int) -> None:
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


def test_a_kill_at_any_file_operation_is_gone_on_from(make_lut: Callable[..., Lut], tmp_path: Path) -> None:
    lut = make_lut()
    make(lut, tmp_path / "whole", 2)
    below = tmp_path / "below"
    step = 0
    killed = True
    while killed:
        step += 1
        below.mkdir()
        killed = dies_at(step, below, lambda: make(lut, below / "out", 2))
        with contextlib.suppress(InputError):  # "already exists", where all that was left were empty folders
            make(lut, below / "out", 2)
        assert contents(below / "out") == contents(tmp_path / "whole"), f"killed before file operation {step}"
        assert [path.name for path in below.iterdir()] == ["out"], f"killed before file operation {step}"
        shutil.rmtree(below)
    assert step > 40


@pytest.mark.parametrize("layout", get_args(Layout))
def test_a_record_is_written_when_its_files_are_on_the_disk(
    make_lut: Callable[..., Lut], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, layout: str
) -> None:
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
    make(make_lut(), tmp_path / "out", layout=layout, workers=2, shard_images=5)
    assert len(checked) >= 2


def test_another_plan_in_the_same_place_is_refused(make_lut: Callable[..., Lut], tmp_path: Path) -> None:
    lut, out = make_lut(), tmp_path / "out"
    with pytest.raises(StopIt):
        make(lut, out, on_image=interrupt_after(4))
    with pytest.raises(
        InputError, match=r"begun with another plan \(seed 3, now 4\); finish it as it was begun, remove"
    ):
        make(lut, out, seed=4)
    with pytest.raises(InputError, match=r"options previews false, now true"):
        make(lut, out, previews=True)
    with pytest.raises(InputError, match=r"8.*6.*4.*3.*4.*3.*sha256"):
        make(lut, out, 3)
    other = make_lut(bits=3, name="other")
    with pytest.raises(InputError, match=r"sha256.*2.*3"):
        make(other, out)
    make(lut, out)


def test_one_program_makes_a_dataset_at_a_time(make_lut: Callable[..., Lut], tmp_path: Path) -> None:
    lut, out = make_lut(), tmp_path / "out"
    plan = Plan(lut, SCENES, ListedLights((0,)), 0, DatasetOptions())
    with (
        workplace(out, plan.identity()),
        pytest.raises(InputError, match="is being made by another program; wait for it"),
    ):
        generate_dataset(lut, out, SCENES, [0])


def plan_of(lut: Lut) -> Plan:
    return Plan(lut, SCENES, RandomLights(3, 4, 9), 9, DatasetOptions(shard_images=2, split=(0.4, 0.3, 0.3)))


def test_shares_make_the_whole(make_lut: Callable[..., Lut], tmp_path: Path) -> None:
    lut, out = make_lut(), tmp_path / "out"
    make_dataset(plan_of(lut), tmp_path / "whole")
    assert make_share(plan_of(lut), out, (1, 3), Workers(count=2)) == (2, 6)
    assert make_share(plan_of(lut), out, (0, 3)) == (4, 6)
    with pytest.raises(InputError, match=r"2 of 6 shards of .* are not made yet: 2, 5; run their shares"):
        finish_dataset(out)
    with pytest.raises(InputError, match="share 3 of 3 was asked for, expected 0 to 2"):
        make_share(plan_of(lut), out, (3, 3))
    assert make_share(plan_of(lut), out, (2, 3)) == (6, 6)
    assert make_share(plan_of(lut), out, (2, 3)) == (6, 6), "made again, nothing changes"
    assert not out.exists()
    finish_dataset(out)
    assert contents(out) == contents(tmp_path / "whole")
    assert not list(tmp_path.glob(".out*"))
    before = contents(out)
    assert finish_dataset(out).description.images == plan_of(lut).total, "finished before: it is there"
    assert contents(out) == before
    with pytest.raises(InputError, match="no dataset is being made at"):
        finish_dataset(tmp_path / "elsewhere")


def test_shares_are_made_beside_each_other(make_lut: Callable[..., Lut], tmp_path: Path) -> None:
    lut = make_lut()
    with workplace(tmp_path / "out", plan_of(lut).identity(), alone=False):
        assert make_share(plan_of(lut), tmp_path / "out", (0, 1)) == (6, 6)
        with pytest.raises(InputError, match="is being made by another program"):
            finish_dataset(tmp_path / "out")


def test_a_share_that_waited_for_the_whole_is_refused(
    make_lut: Callable[..., Lut], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its work could never become a dataset, and would stay under the hidden name."""
    lut, out = make_lut(), tmp_path / "out"
    make_dataset(plan_of(lut), tmp_path / "whole")

    def finished_meanwhile(*arguments: Any, **named: Any) -> contextlib.AbstractContextManager[FolderLock]:
        (tmp_path / "whole").rename(out)
        return held_folder(*arguments, **named)

    monkeypatch.setattr("generator.dataset.workplace.held_folder", finished_meanwhile)
    with pytest.raises(InputError, match="already exists; name another place"):
        make_share(plan_of(lut), out, (0, 2))
    assert not (tmp_path / ".out.partial").exists()


def test_a_damaged_record_and_a_changed_source_are_reported(make_lut: Callable[..., Lut], tmp_path: Path) -> None:
    lut, out = make_lut(), tmp_path / "out"
    make_share(plan_of(lut), out, (0, 1))
    (record,) = (tmp_path / ".out.partial" / "plan" / "shards").glob("000001.*.json")
    text = record.read_text()
    record.write_text(text[:-9])
    with pytest.raises(FormatError, match=r"000001\.\w+\.json: damaged: .*; remove it and run the same command again"):
        finish_dataset(out)
    record.write_text(text.replace('"width":24', '"width":25'))
    with pytest.raises(FormatError, match="random-000000"):
        finish_dataset(out)
    record.unlink()
    make_dataset(plan_of(lut), out)
    make_dataset(plan_of(lut), tmp_path / "whole")
    assert contents(out) == contents(tmp_path / "whole")
