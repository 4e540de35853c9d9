"""Shards: work that was interrupted, killed or disturbed ends in the same bytes; images as the options say."""

from __future__ import annotations

import contextlib
import csv
import hashlib
import os
import pickle
import shutil
import signal
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, get_args

import cv2
import numpy as np
import pytest

from calibration.table.lut import Lut
from evaluation.datasets.generated import open_generated
from evaluation.scene import MixedScene
from foundation.errors import FormatError, InputError
from foundation.files import partial_path
from foundation.folders import FolderLock, locked_folder
from generator.cli import main
from generator.dataset import layouts as plain_files
from generator.dataset import shards
from generator.dataset.making import Workers, generate_dataset, make_dataset, make_share, workplace
from generator.dataset.plan import DatasetOptions, Plan
from generator.dataset.reader import Dataset, file_faults, open_dataset
from generator.dataset.records import FinishedImage, Layout, ShardRecord
from generator.dataset.shards import SILENT, Callbacks, Workplace, make_shard
from generator.kernels.printing import draw_printed
from generator.kernels.rendering import draw_samples
from generator.lights.choices import SimultaneousLights
from generator.lights.lighting import ListedLights, Mixture, RandomLights, plain
from generator.masks.making import FULL, parse_masks
from generator.masks.maps import quantised_chromaticities
from generator.options import LightOptions
from generator.pictures.random_scenes import random_scenes
from generator.pictures.sources import Preparation, Source, find_pictures, read_picture
from generator.rendering.black_points import BlackPoint, black_subtraction, subtract_black
from generator.rendering.colorimetric import ColorimetricRendering
from generator.rendering.matrices import ColourMatrix
from generator.rendering.render import render
from generator.variation.iso_speed import parse_iso
from generator.variation.variation import Variation, parse_exposure, parse_gradient, variation_of
from tests.generator.conftest import MakeLut, lut_in
from tests.generator.dataset.contents import contents
from tests.generator.groups import grouped
from tests.generator.rendering.conftest import make_table as make_table_of_a_print

pytestmark = pytest.mark.slow


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


def test_images_of_an_unfinished_shard_stay_if_another_plan_is_refused(make_lut: MakeLut, tmp_path: Path) -> None:
    lut, out = make_lut(), tmp_path / "out"
    with pytest.raises(StopIt):
        make(lut, out, shard_images=100, on_image=interrupt_after(3))
    begun = sorted(partial_path(out).rglob("*"))
    with pytest.raises(InputError, match="seed 3, now 4"):
        make(lut, out, shard_images=100, seed=4)
    assert sorted(partial_path(out).rglob("*")) == begun


def test_one_program_makes_a_dataset_at_a_time(make_lut: MakeLut, tmp_path: Path) -> None:
    lut, out = make_lut(), tmp_path / "out"
    plan = Plan(lut, SCENES, ListedLights((0,)), 0, DatasetOptions())
    with (
        workplace(out, plan.identity()),
        pytest.raises(InputError),
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
        with pytest.raises(InputError):
            make_dataset(plan_of(lut), tmp_path / "out")


def test_a_shard_is_made_twice_and_by_two_programs_at_once(
    make_lut: MakeLut, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lut, out = make_lut(), tmp_path / "out"
    plan = plan_of(lut)
    make_dataset(plan, tmp_path / "whole")
    done = Workplace.done

    def done_by_another_meanwhile(place: Workplace, wanted: range) -> set[int]:
        found = done(place, wanted)
        with monkeypatch.context() as other:
            other.setattr(Workplace, "done", done)
            make_share(plan, out, (0, 2))
        return found

    with workplace(out, plan.identity(), alone=False) as place, ThreadPoolExecutor(1) as pool:
        assert make_shard(plan.job(1), lut, place, pool, 1) == make_shard(plan.job(1), lut, place, pool, 1)
        monkeypatch.setattr(Workplace, "done", done_by_another_meanwhile)
        assert make_share(plan, out, (0, 2)) == (4, 6)
        monkeypatch.undo()
        assert make_share(plan, out, (0, 1)) == (6, 6)
    make_dataset(plan, out)
    assert contents(out) == contents(tmp_path / "whole")


def test_a_share_reads_the_records_of_its_own_shards(
    make_lut: MakeLut, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lut, out, read = make_lut(), tmp_path / "out", set[int]()
    make_share(plan_of(lut), out, (0, 2))
    killed_after(1, lambda: make_share(plan_of(lut), out, (3, 6)))
    pieces = Workplace.pieces

    def noted(place: Workplace, shard: int) -> dict[str, Any]:
        read.add(shard)
        return pieces(place, shard)

    monkeypatch.setattr(Workplace, "pieces", noted)
    assert make_share(plan_of(lut), out, (1, 6)) == (4, 6), "shard 3 has finished images, and is not done"
    assert read == {1}


def test_a_share_that_waited_for_the_whole_is_refused(
    make_lut: MakeLut, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its work could never become a dataset, and would stay under the hidden name."""
    lut, out = make_lut(), tmp_path / "out"
    make_dataset(plan_of(lut), tmp_path / "whole")

    def finished_meanwhile(*arguments: Any, **named: Any) -> contextlib.AbstractContextManager[FolderLock]:
        (tmp_path / "whole").rename(out)
        return locked_folder(*arguments, **named)

    monkeypatch.setattr("generator.dataset.making.locked_folder", finished_meanwhile)
    with pytest.raises(InputError):
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


make_table = make_table_of_a_print

MATRIX = ColourMatrix("mine", np.array([[0.6, 0.3, 0.1], [0.1, 0.7, 0.2], [0.05, 0.25, 0.7]]), "a test")

BY_COLOUR = DatasetOptions(rendering="colorimetric", matrix=MATRIX, black_point=BlackPoint("random"), previews=False)


@pytest.fixture
def pictures(tmp_path: Path) -> Path:
    folder = tmp_path / "pictures"
    folder.mkdir()
    rng = np.random.default_rng(2)
    for name, shape in (("a.png", (40, 70, 3)), ("b.png", (51, 38, 3)), ("c.png", (36, 100, 3))):
        codes = rng.integers(0, 256, shape).astype(np.uint8)
        (folder / name).write_bytes(cv2.imencode(".png", codes)[1].tobytes())
    return folder


def made(lut: Lut, pictures: Path, out: Path, options: DatasetOptions, **more: Any) -> dict[str, str]:
    """Make a dataset under lights 1 and 2 and return the hash of every file."""
    generate_dataset(lut, out, find_pictures(pictures), [1, 2], seed=5, options=options, **more)
    return contents(out)


def rows_of(out: Path) -> list[dict[str, str]]:
    return list(csv.DictReader((out / "images.csv").read_text().splitlines()))


def test_an_image_is_that_of_its_light_without_a_share_of_black(
    make_lut: MakeLut, pictures: Path, tmp_path: Path
) -> None:
    lut = make_lut(bits=3)
    made(lut, pictures, tmp_path / "codes", DatasetOptions(previews=False))
    made(lut, pictures, tmp_path / "colours", BY_COLOUR)
    of_codes, dataset = open_dataset(tmp_path / "codes"), open_dataset(tmp_path / "colours")
    rendering = ColorimetricRendering(lut, MATRIX)
    sources = {source.name: source.read().picture for source in find_pictures(pictures)}
    rows = rows_of(tmp_path / "colours")
    assert dataset.details == {row["image"]: {key: row[key] for key in row if key != "image"} for row in rows}
    for number, (entry, before, row) in enumerate(zip(dataset.entries, of_codes.entries, rows, strict=True)):
        light = plain(int(entry.lights[0]))
        share = BY_COLOUR.black_point.share(5, number)
        assert row["cells"] == rendering.map.sha256[:16]
        printed = rendering.printed_light(light, share)
        image = draw_printed(lut.samples, sources[entry.source], [printed], rendering.cells, seed=5, image=number)
        np.testing.assert_array_equal(dataset.read_image(entry), np.minimum(image, lut.provenance.white_level))
        assert float(row["black_taken"]) == pytest.approx(share, abs=1e-8)
        assert 0 <= float(row["outside"]) <= 1
        assert float(row["distance"]) >= 0
        assert row["image"] == entry.image
        # The ground truth is the light's, whatever becomes of the print.
        assert (entry.truth, entry.truths) == (before.truth, before.truths)
    made_of = dataset.description
    assert made_of.rendering is not None
    pixels = [sources[entry.source].size for entry in dataset.entries]
    for name in ("outside", "distance"):
        mean = np.average([float(row[name]) for row in rows], weights=pixels)
        assert getattr(made_of.rendering, name) == pytest.approx(mean, abs=1e-6)


def test_what_was_begun_or_made_by_codes_goes_on_so(make_lut: MakeLut, pictures: Path, tmp_path: Path) -> None:
    lut, out = make_lut(), str(tmp_path / "out")
    wish = (str(lut.folder), out, "--sources", str(pictures), "--light", "1,2", "--seed", "5")
    assert main((*wish, "--rendering", "codes", "--shard", "0/2", "--shard-images", "2")) == 0
    assert main((*wish, "--shard-images", "2")) == 0
    assert open_dataset(out).description.rendering is None
    # It is there, and nothing else was asked for.
    assert main((*wish, "--shard-images", "2")) == 0
    assert main((*wish, "--shard-images", "2", "--rendering", "colorimetric")) == 2


def test_workers_shards_shares_and_other_processes_change_no_byte(
    make_lut: MakeLut, pictures: Path, tmp_path: Path
) -> None:
    lut = make_lut()
    one = made(lut, pictures, tmp_path / "one", BY_COLOUR, workers=1)
    assert made(lut, pictures, tmp_path / "three", BY_COLOUR, workers=3) == one
    plan = Plan(lut, find_pictures(pictures), ListedLights((1, 2)), 5, BY_COLOUR)
    job = pickle.loads(pickle.dumps(plan.job(0)))
    out = tmp_path / "shares"
    with workplace(out, plan.identity(), alone=False) as place, ThreadPoolExecutor(1) as pool:
        make_shard(job, lut, place, pool, 1)
    make_share(plan, out, (0, 1))
    make_dataset(plan, out)
    assert {name: one[name] for name in ("images.csv", "dataset.json", "images/000003.png")} == {
        name: hashlib.sha256((out / name).read_bytes()).hexdigest()
        for name in ("images.csv", "dataset.json", "images/000003.png")
    }


def test_several_lights_share_an_image(make_lut: MakeLut, pictures: Path, tmp_path: Path) -> None:
    lut = make_lut(bits=3)
    choice = LightOptions(random=1, lights_per_image=2, masks="half-plane").choose(lut, 5)
    sources = find_pictures(pictures)
    plan_options = DatasetOptions(rendering="colorimetric", matrix=MATRIX, black_point=BlackPoint("compensate"))
    dataset = generate_dataset(lut, tmp_path / "out", sources, choice, seed=5, options=plan_options)
    rendering = ColorimetricRendering(lut, MATRIX)
    for number, (entry, source) in enumerate(zip(dataset.entries, sources, strict=True)):
        lighting = choice.lightings_of(number)[0]
        weights = dataset.read_weights(entry)
        lights = [rendering.printed_light(mixture, 1.0) for mixture in lighting.mixtures]
        wanted = draw_printed(
            lut.samples,
            source.read().picture,
            lights,
            rendering.cells,
            shares=weights,
            white_level=lut.provenance.white_level,
            seed=5,
            image=number,
        )
        np.testing.assert_array_equal(dataset.read_image(entry), wanted)
        truth = quantised_chromaticities(weights, lighting.whites(lut), FULL) / FULL
        np.testing.assert_allclose(dataset.read_ground_truth_map(entry), truth, atol=2e-5)


def test_a_mixture_of_lights_has_the_black_of_the_mixture(make_lut: MakeLut, pictures: Path, tmp_path: Path) -> None:
    lut = make_lut()
    mixture = Mixture((0, 3), (0.25, 0.75))
    options = DatasetOptions(rendering="codes", black_point=BlackPoint("compensate"))
    request = LightOptions(light=[mixture.label]).choose(lut, 5)
    dataset = generate_dataset(lut, tmp_path / "out", find_pictures(pictures), request, seed=5, options=options)
    picture = next(iter(find_pictures(pictures))).read().picture
    samples = subtract_black(mixture.samples(lut, 5), black_subtraction(lut, mixture, 1.0), lut.provenance.white_level)
    image = dataset.read_image(dataset.entries[0])
    np.testing.assert_array_equal(image, draw_samples(samples, picture, seed=5, image=0))


def test_faults_are_named() -> None:
    with pytest.raises(InputError):
        DatasetOptions(rendering="codes", matrix=MATRIX)
    with pytest.raises(InputError, match="'inks'"):
        DatasetOptions(rendering="inks")  # pyrefly: ignore[bad-argument-type]


Make = Callable[..., Dataset]


@pytest.fixture
def lut(make_lut: MakeLut) -> Lut:
    """Return a table of 512 colours, enough to tell its noise."""
    return make_lut(bits=3)


@pytest.fixture
def varied_pictures(tmp_path: Path) -> Path:
    """Return a folder of four varied_pictures with colours that change slowly."""
    folder = tmp_path / "varied_pictures"
    folder.mkdir()
    rng = np.random.default_rng(2)
    for name in "abcd":
        coarse = rng.integers(0, 256, (6, 8, 3)).astype(np.uint8)
        codes = cv2.resize(coarse, (96, 72), interpolation=cv2.INTER_CUBIC)
        (folder / f"{name}.png").write_bytes(cv2.imencode(".png", codes)[1].tobytes())
    return folder


@pytest.fixture
def make_varied(lut: Lut, varied_pictures: Path, tmp_path: Path) -> Make:
    """Return a maker of datasets of the varied_pictures under two lights each."""

    def made(
        name: str, variation: Variation | None = None, crops: int = 1, lights: Any = None, workers: int = 1, **more: Any
    ) -> Dataset:
        preparation = Preparation(crop=(32, 24), crops=crops, seed=5) if crops > 1 else Preparation()
        options = DatasetOptions(form="tiff", previews=False, variation=variation, crops=crops, shard_images=3, **more)
        choice = lights or RandomLights(2, len(lut.white), 5)
        sources = find_pictures(varied_pictures, preparation)
        return generate_dataset(
            lut, tmp_path / name, sources, choice, seed=5, options=options, workers=Workers(count=workers)
        )

    return made


def everything(lut: Lut) -> Variation:
    return variation_of(
        lut, parse_exposure("stops:low=-2,high=2"), parse_gradient("smooth:stops=1"), parse_iso("400/100:read=1")
    )


def test_truths_and_choices_do_not_change_with_exposure_and_noise(lut: Lut, make_varied: Make) -> None:
    plain, varied = make_varied("plain"), make_varied("varied", everything(lut))
    assert [(e.image, e.source, e.lights, e.truths, e.truth) for e in plain.entries] == [
        (e.image, e.source, e.lights, e.truths, e.truth) for e in varied.entries
    ]
    assert list(varied.details) == [entry.image for entry in varied.entries]
    names = ["end_r", "end_g", "end_b", "exposure", "iso", "clipped"]
    for entry in varied.entries:
        assert [*varied.details[entry.image]] == ["cells", "outside", "distance", *names]
        row = {name: float(varied.details[entry.image][name]) for name in names}
        assert 0.25 <= row["exposure"] <= 4
        assert row["iso"] == pytest.approx(400)
        # Where light falls off, all channels do by as much: an image's mean is the plain one's times some number.
        one, other = (set_.read_image(entry).astype(np.float64).mean(axis=(0, 1)) for set_ in (plain, varied))
        if row["clipped"] < 0.001:
            ratio = other / one / row["exposure"]
            assert row["end_g"] - 0.05 < ratio.min()
            assert ratio.max() < 1.05
    assert list(file_faults(varied.store.place)) == []


def test_workers_layouts_and_kills_do_not_change_an_image(lut: Lut, make_varied: Make, tmp_path: Path) -> None:
    options = {"variation": everything(lut), "crops": 2}
    make_varied("one", **options)
    make_varied("three", workers=3, **options)
    assert contents(tmp_path / "one") == contents(tmp_path / "three")
    one = open_dataset(tmp_path / "one")
    for layout in ("webdataset", "parquet"):
        other = make_varied(layout, layout=layout, **options)
        assert other.details == one.details
        for entry, its in zip(one.entries, other.entries, strict=True):
            np.testing.assert_array_equal(one.read_image(entry), other.read_image(its))


def test_the_share_that_is_clipped_is_the_one_asked_for(lut: Lut, make_varied: Make) -> None:
    dataset = make_varied("clipped", variation_of(lut, parse_exposure("clip:share=.05,most=50")))
    white = dataset.description.table.white_level
    for entry in dataset.entries:
        image = dataset.read_image(entry)
        assert image.max() == white
        clipped = (image.max(axis=2) == white).mean()
        assert float(dataset.details[entry.image]["clipped"]) == pytest.approx(clipped, rel=1e-6)
        # Of 6912 pixels; more only where several have the count at which the share ends.
        assert 0.05 <= clipped + 1 / 6912 < 0.06
    # Noise lifts the brightest pixels: a factor that is chosen without it clips more.
    noisy = make_varied("noisy", variation_of(lut, parse_exposure("clip:share=.05,most=50"), iso=parse_iso("6400/100")))
    shares = [float(row["clipped"]) for row in noisy.details.values()]
    assert np.abs(np.array(shares) / 0.05 - 1).max() < 0.06
    unclipped = make_varied("unclipped", variation_of(lut, parse_exposure("clip:share=0,most=50")))
    assert all(float(row["clipped"]) == 0 for row in unclipped.details.values())
    assert all(unclipped.read_image(entry).max() >= white - 8 for entry in unclipped.entries)


def test_crops_are_numbered_recorded_and_stay_together(make_varied: Make, varied_pictures: Path, lut: Lut) -> None:
    dataset = make_varied("crops", crops=3, split=(0.5, 0.2, 0.3))
    assert len(dataset.entries) == 4 * 3 * 2
    assert len(dataset.sources) == 4
    for number, entry in enumerate(dataset.entries):
        row = dataset.details[entry.image]
        assert entry.image == f"{number:06d}.tiff"
        assert (entry.source, int(row["crop"])) == ("abcd"[number // 6] + ".png", number // 2 % 3)
        left, top = int(row["left"]), int(row["top"])
        cut = read_picture(varied_pictures / entry.source)[top : top + 24, left : left + 32]
        expected = render(lut, np.ascontiguousarray(cut), int(entry.illumination), seed=5, image=number)
        np.testing.assert_array_equal(dataset.read_image(entry), expected)
    # All crops of a picture are in one part, and in one group of folds.
    parts = {
        entry.source: {other.split for other in dataset.entries if other.source == entry.source}
        for entry in dataset.entries
    }
    assert all(len(its) == 1 for its in parts.values())
    assert {getattr(scene, "group", "") for scene in open_generated(dataset.store.place).scenes} == set(parts)
    # Each crop has lights of its own.
    assert len({tuple(entry.illumination for entry in dataset.entries[at : at + 2]) for at in range(0, 24, 2)}) > 4
    assert dataset.description.pixels == 4 * 3 * 32 * 24


def test_crops_that_the_sources_do_not_have(lut: Lut, varied_pictures: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="has 1 crops, expected 2"):
        generate_dataset(lut, tmp_path / "out", find_pictures(varied_pictures), [0], options=DatasetOptions(crops=2))


def test_a_tint_has_maps_that_are_true(lut: Lut, make_varied: Make) -> None:
    gradient = parse_gradient("soft-edge:width=.9,stops=1,least=1,colour=.5")
    dataset = make_varied("tint", variation_of(lut, gradient=gradient))
    plain = make_varied("plain")
    scenes = open_generated(dataset.store.place).scenes
    for entry, flat, scene in zip(dataset.entries, plain.entries, scenes, strict=True):
        row = dataset.details[entry.image]
        end = np.array([float(row[f"end_{channel}"]) for channel in "rgb"])
        light = int(entry.illumination)
        assert entry.lights == (str(light), str(light))
        np.testing.assert_allclose(entry.truths[0], lut.ground_truth[light], atol=1e-9)
        weights = dataset.read_weights(entry).astype(np.float64)
        here = weights @ np.array([lut.white[light], lut.white[light] * end])
        np.testing.assert_allclose(
            dataset.read_ground_truth_map(entry), here / here.sum(axis=2, keepdims=True), atol=2e-5
        )
        mean = here.mean(axis=(0, 1))
        np.testing.assert_allclose(entry.truth, mean / mean.sum(), atol=1e-7)
        # The image is the plain one in the light that the map tells of.
        ratio = dataset.read_image(entry) / np.maximum(plain.read_image(flat), 1.0) / (here / lut.white[light])
        assert np.abs(np.median(ratio, axis=(0, 1)) - 1).max() < 0.01
        assert isinstance(scene, MixedScene)


def test_several_lights_that_fall_off_are_weighed_by_their_light(lut: Lut, make_varied: Make) -> None:
    choice = SimultaneousLights(RandomLights(2, len(lut.white), 5), 2, parse_masks("half-plane:angle=0", 2, 5))
    gradient = variation_of(lut, gradient=parse_gradient("soft-edge:angle=0,width=.9,stops=3,least=3"))
    dataset = make_varied("several", gradient, lights=choice)
    plain = make_varied("plain", lights=choice)
    moved = 0.0
    for entry, flat in zip(dataset.entries, plain.entries, strict=True):
        weights = dataset.read_weights(entry).astype(np.float64)
        np.testing.assert_array_equal(weights, plain.read_weights(flat))
        falloff = parse_gradient("soft-edge:angle=0,width=.9,stops=3,least=3").of_image(5, int(entry.image[:6]))
        level = 1 - falloff.weights(*weights.shape[:2])[..., 1] * (1 - falloff.end[0])
        mean = (weights * level[..., None]).mean(axis=(0, 1)) @ lut.white[[int(light) for light in entry.lights]]
        np.testing.assert_allclose(entry.truth, mean / mean.sum(), atol=1e-6)
        moved = max(moved, np.abs(np.subtract(entry.truth, flat.truth)).max())
    # In the world where the falling off is forgotten, the truth would be the plain one.
    assert moved > 0.001


def test_tints_and_several_lights_are_refused(lut: Lut, make_varied: Make) -> None:
    choice = SimultaneousLights(RandomLights(2, len(lut.white), 5), 2, parse_masks("smooth", 2, 5))
    with pytest.raises(InputError):
        make_varied("both", variation_of(lut, gradient=parse_gradient("smooth:colour=.1")), lights=choice)


def test_raw_files_hold_the_same_counts(lut: Lut, make_varied: Make, varied_pictures: Path, tmp_path: Path) -> None:
    variation = everything(lut)
    options = DatasetOptions(form="dng", previews=False, variation=variation)
    raw = generate_dataset(
        lut,
        tmp_path / "raw",
        find_pictures(varied_pictures),
        RandomLights(2, 4, 5),
        seed=5,
        options=options,
    )
    plain = make_varied("tiff", variation)
    assert raw.details == {name.replace("tiff", "dng"): row for name, row in plain.details.items()}
    for one, other in zip(raw.entries, plain.entries, strict=True):
        halved, image = raw.read_image(one), plain.read_image(other)
        np.testing.assert_array_equal(halved[..., 0], image[0::2, 0::2, 0])
        np.testing.assert_array_equal(halved[..., 2], image[1::2, 1::2, 2])
