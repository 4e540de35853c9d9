"""Shards: equal bytes after interruptions, kills and damage, and images for every option."""

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
from generator.dataset.making import Workers, generate_dataset, make_dataset, make_share, open_workplace
from generator.dataset.plan import DatasetOptions, Plan
from generator.dataset.reader import Dataset, file_faults, open_dataset
from generator.dataset.records import FinishedImage, Layout, ShardRecord
from generator.dataset.shards import SILENT, Callbacks, Workplace, make_shard
from generator.kernels.printing import draw_printed
from generator.kernels.rendering import draw_samples
from generator.lights.choices import SimultaneousLights
from generator.lights.lighting import ListedLights, Mixture, RandomLights, single_mixture
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
def test_resumed_run_gives_same_bytes(make_lut: MakeLut, tmp_path: Path, layout: str, workers: int) -> None:
    lut = make_lut()
    make(lut, tmp_path / "whole", layout=layout)
    with pytest.raises(StopIt):
        make(lut, tmp_path / "out", layout=layout, workers=workers, on_image=interrupt_after(4))
    assert not (tmp_path / "out").exists()
    assert len(list((tmp_path / ".out.partial" / "plan" / "shards").iterdir())) in (1, 2, 3, 4)
    count: list[None] = []
    make(lut, tmp_path / "out", layout=layout, workers=workers, on_image=lambda: count.append(None))
    assert len(count) < 8, "finished images are made again"
    assert contents(tmp_path / "out") == contents(tmp_path / "whole")
    assert not list(tmp_path.glob(".out*"))


# Number of reused images, number of reported images, and numbers of rendered images.
RunCounts = tuple[int, int, list[int]]


def counts_of_run(monkeypatch: pytest.MonkeyPatch, call: Callable[[Callbacks], object]) -> RunCounts:
    """Run `call`, which makes images, and return its counts."""
    reused: list[int] = []
    reported: list[None] = []
    rendered: list[int] = []
    photograph = shards.photograph

    def recorded(*arguments: Any) -> Any:
        rendered.append(arguments[5])
        return photograph(*arguments)

    with monkeypatch.context() as patched:
        patched.setattr(shards, "photograph", recorded)
        call(Callbacks(on_done=reused.append, on_image=lambda: reported.append(None)))
    return sum(reused), len(reported), sorted(rendered)


def killed_after(images: int, action: Callable[[], object]) -> None:
    """Run `action` in a process that is killed after it has finished this number of images."""
    child = os.fork()
    if not child:
        counted = iter(range(images - 1))
        note = Workplace.note

        def recorded(self: Workplace, shard: int, image: FinishedImage) -> None:
            note(self, shard, image)
            if next(counted, None) is None:
                os.kill(os.getpid(), signal.SIGKILL)

        Workplace.note = recorded  # pyrefly: ignore[method-assign]
        try:
            action()
        finally:
            os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL


def make_one_shard(
    lut: Lut,
    out: Path,
    callbacks: Callbacks = SILENT,
    workers: Workers | None = None,
    sources: Sequence[Source] = SCENES,
) -> Dataset:
    """Make eight images under two illuminants each, with previews, masks and details, in one shard."""
    choice = SimultaneousLights(ListedLights((2, 0, 1, 3)), 2, parse_masks("half-plane", 2, 5))
    options = DatasetOptions(rendering="codes", black_point=BlackPoint("random"), split=(0.5, 0.0, 0.5))
    plan = Plan(lut, sources, choice, 3, options)
    return make_dataset(plan, out, workers, callbacks)


def recorded_images(out: Path) -> list[int]:
    """Return the numbers of images with complete lines in the record."""
    lines = filter(None, record_file(out).read_bytes().splitlines())
    return [int(line.split(b"\t")[1]) for line in lines if line.endswith(b"}")]


def record_file(out: Path) -> Path:
    (notes,) = (out.with_name(f".{out.name}.partial") / "plan" / "shards").iterdir()
    return notes


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Lut, dict[str, str]]:
    """Return a LUT, and the hashes of the files that `make_one_shard` makes without interruption."""
    folder = tmp_path_factory.mktemp("whole")
    lut = lut_in(folder / "lut")
    make_one_shard(lut, folder / "out")
    return lut, contents(folder / "out")


@pytest.mark.parametrize("count", [1, 3])
def test_reuses_images_of_killed_shard(
    undisturbed: tuple[Lut, dict[str, str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, count: int
) -> None:
    (lut, expected), out, workers = undisturbed, tmp_path / "out", Workers(count=count)
    killed_after(3, lambda: make_one_shard(lut, out, workers=workers))
    recorded = recorded_images(out)
    assert 3 <= len(recorded) < 8
    assert count > 1 or recorded == [0, 1, 2]
    reused, reported, rendered = counts_of_run(
        monkeypatch, lambda callbacks: make_one_shard(lut, out, callbacks, workers)
    )
    assert (reused, reported) == (len(recorded), 8 - len(recorded))
    assert rendered == sorted(set(range(8)) - set(recorded))
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


@pytest.mark.parametrize("damage", [cut_file, changed_mask, lost_preview, cut_line, cut_end, other_truth])
def test_repeats_damaged_images(
    undisturbed: tuple[Lut, dict[str, str]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    damage: Callable[[Path, Path], None],
) -> None:
    (lut, expected), out = undisturbed, tmp_path / "out"
    killed_after(3, lambda: make_one_shard(lut, out))
    (files,) = (tmp_path / ".out.partial").glob("dataset-*")
    damage(files, record_file(out))
    # A second kill, so that complete lines follow an incomplete one.
    killed_after(1, lambda: make_one_shard(lut, out))
    assert recorded_images(out)[-1] == (2 if damage is cut_end else 1)
    assert counts_of_run(monkeypatch, lambda callbacks: make_one_shard(lut, out, callbacks)) == (3, 5, [3, 4, 5, 6, 7])
    assert contents(out) == expected


def test_repeats_images_of_changed_picture(make_lut: MakeLut, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lut, out, folder = make_lut(), tmp_path / "out", tmp_path / "pictures"
    folder.mkdir()

    def draw(name: str, code: int) -> None:
        assert cv2.imwrite(str(folder / f"{name}.png"), np.full((16, 24, 3), code, np.uint8))

    for index, name in enumerate("abcd"):
        draw(name, 50 * index)
    sources = find_pictures(folder)
    killed_after(7, lambda: make_one_shard(lut, out, sources=sources))
    draw("a", 9)
    draw("d", 10)
    counts = counts_of_run(monkeypatch, lambda callbacks: make_one_shard(lut, out, callbacks, sources=sources))
    assert counts == (4, 4, [0, 1, 6, 7]), "one image of d was finished"
    make_one_shard(lut, tmp_path / "whole", sources=sources)
    assert contents(out) == contents(tmp_path / "whole")


def test_skips_images_of_removed_picture(make_lut: MakeLut, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lut, out, folder = make_lut(), tmp_path / "out", tmp_path / "pictures"
    folder.mkdir()
    for name in "abcd":
        assert cv2.imwrite(str(folder / f"{name}.png"), np.full((16, 24, 3), ord(name), np.uint8))
    sources = find_pictures(folder)
    killed_after(5, lambda: make_one_shard(lut, out, sources=sources))
    (folder / "a.png").unlink()
    counts = counts_of_run(monkeypatch, lambda callbacks: make_one_shard(lut, out, callbacks, sources=sources))
    assert counts == (3, 3, [5, 6, 7])
    assert len(open_dataset(out).entries) == 6


def is_killed_at(step: int, below: Path, action: Callable[[], object]) -> bool:
    """Run `action` in a process that is killed before file operation number `step`; return whether it was killed."""
    child = os.fork()
    if not child:
        steps = 0
        watched_events = {"open", "os.rename", "os.mkdir", "os.remove", "os.rmdir"}

        def watch(event: str, arguments: tuple[Any, ...]) -> None:
            nonlocal steps
            if event in watched_events and str(arguments[0]).startswith(str(below)):
                steps += 1
                if steps == step:
                    os.kill(os.getpid(), signal.SIGKILL)

        sys.addaudithook(watch)
        try:
            action()
        finally:
            os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL


STRIDE = 7  # Runs are killed before every seventh file operation, because each kill takes two runs


def test_resumes_after_kill_at_any_file_operation(make_lut: MakeLut, tmp_path: Path) -> None:
    lut = make_lut()
    make(lut, tmp_path / "whole", 1, shard_images=1)
    below = tmp_path / "below"
    step = 1 - STRIDE
    killed = True
    while killed:
        step += STRIDE
        below.mkdir()
        killed = is_killed_at(step, below, lambda: make(lut, below / "out", 1, shard_images=1))
        with contextlib.suppress(InputError):  # "already exists", if only empty folders were left
            make(lut, below / "out", 1, shard_images=1)
        assert contents(below / "out") == contents(tmp_path / "whole"), f"killed before file operation {step}"
        assert [path.name for path in below.iterdir()] == ["out"], f"killed before file operation {step}"
        shutil.rmtree(below)
    assert step > 40


@pytest.mark.parametrize(
    ("layout", "is_started"), [*((layout, False) for layout in get_args(Layout)), ("folder", True)]
)
def test_writes_record_after_syncing_files(
    make_lut: MakeLut, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, layout: str, is_started: bool
) -> None:
    lut = make_lut()
    if is_started:
        killed_after(3, lambda: make(lut, tmp_path / "out", layout=layout, shard_images=5))
    synced: set[int] = set()
    checked: list[str] = []
    fsync, commit = os.fsync, Workplace.commit

    def recorded(handle: int) -> None:
        fsync(handle)
        synced.add(os.fstat(handle).st_ino)

    def checking(workplace: Workplace, record: ShardRecord) -> None:
        for file in record.files:
            path = Path(workplace.files.location) / file.name
            assert {path.stat().st_ino, path.parent.stat().st_ino} <= synced, f"{file.name} is only in memory"
            checked.append(file.name)
        commit(workplace, record)

    monkeypatch.setattr(plain_files, "_SYNCED_IMAGES", 2)
    monkeypatch.setattr(os, "fsync", recorded)
    monkeypatch.setattr(Workplace, "commit", checking)
    make(lut, tmp_path / "out", layout=layout, workers=2, shard_images=5)
    assert len(checked) >= 2


def test_refuses_other_plan(make_lut: MakeLut, tmp_path: Path) -> None:
    lut, out = make_lut(), tmp_path / "out"
    with pytest.raises(StopIt):
        make(lut, out, on_image=interrupt_after(4))
    with pytest.raises(InputError, match=r"\(seed 3, now 4\).*remove"):
        make(lut, out, seed=4)
    with pytest.raises(InputError, match=r"previews false, now true"):
        make(lut, out, previews=True)
    with pytest.raises(InputError, match=r"8.*6.*4.*3.*4.*3.*sha256"):
        make(lut, out, 3)
    other_lut = make_lut(bits=3, name="other")
    with pytest.raises(InputError, match=r"sha256.*2.*3"):
        make(other_lut, out)
    make(lut, out)


def test_keeps_images_when_other_plan_is_refused(make_lut: MakeLut, tmp_path: Path) -> None:
    lut, out = make_lut(), tmp_path / "out"
    with pytest.raises(StopIt):
        make(lut, out, shard_images=100, on_image=interrupt_after(3))
    is_started = sorted(partial_path(out).rglob("*"))
    with pytest.raises(InputError, match="seed 3, now 4"):
        make(lut, out, shard_images=100, seed=4)
    assert sorted(partial_path(out).rglob("*")) == is_started


def test_locks_data_set(make_lut: MakeLut, tmp_path: Path) -> None:
    lut, out = make_lut(), tmp_path / "out"
    plan = Plan(lut, SCENES, ListedLights((0,)), 0, DatasetOptions())
    with (
        open_workplace(out, plan.identity()),
        pytest.raises(InputError),
    ):
        generate_dataset(lut, out, SCENES, [0])


def plan_of(lut: Lut) -> Plan:
    return Plan(
        lut, SCENES, RandomLights(3, 4, 9), 9, DatasetOptions(rendering="codes", shard_images=2, split=(0.4, 0.3, 0.3))
    )


def test_shares_give_complete_data_set(make_lut: MakeLut, tmp_path: Path) -> None:
    lut, out = make_lut(), tmp_path / "out"
    make_dataset(plan_of(lut), tmp_path / "whole")
    assert make_share(plan_of(lut), out, (1, 3), Workers(count=2)) == (2, 6)
    assert make_share(plan_of(lut), out, (0, 3)) == (4, 6)
    with pytest.raises(InputError, match=r"share is 3 of 3, expected 0 to 2"):
        make_share(plan_of(lut), out, (3, 3))
    assert make_share(plan_of(lut), out, (2, 3)) == (6, 6)
    assert make_share(plan_of(lut), out, (2, 3)) == (6, 6), "a repeated share changes nothing"
    assert not out.exists()
    make_dataset(plan_of(lut), out)
    assert contents(out) == contents(tmp_path / "whole")
    assert not list(tmp_path.glob(".out*"))


def test_shares_run_in_parallel(make_lut: MakeLut, tmp_path: Path) -> None:
    lut = make_lut()
    with open_workplace(tmp_path / "out", plan_of(lut).identity(), exclusive=False):
        assert make_share(plan_of(lut), tmp_path / "out", (0, 1)) == (6, 6)
        with pytest.raises(InputError):
            make_dataset(plan_of(lut), tmp_path / "out")


def test_shard_made_twice_is_equal(make_lut: MakeLut, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lut, out = make_lut(), tmp_path / "out"
    plan = plan_of(lut)
    make_dataset(plan, tmp_path / "whole")
    original = Workplace.done

    def done_with_concurrent_share(workplace: Workplace, shard_numbers: range) -> set[int]:
        reused = original(workplace, shard_numbers)
        with monkeypatch.context() as patched:
            patched.setattr(Workplace, "done", original)
            make_share(plan, out, (0, 2))
        return reused

    with open_workplace(out, plan.identity(), exclusive=False) as workplace, ThreadPoolExecutor(1) as pool:
        assert make_shard(plan.job(1), lut, workplace, pool, 1) == make_shard(plan.job(1), lut, workplace, pool, 1)
        monkeypatch.setattr(Workplace, "done", done_with_concurrent_share)
        assert make_share(plan, out, (0, 2)) == (4, 6)
        monkeypatch.undo()
        assert make_share(plan, out, (0, 1)) == (6, 6)
    make_dataset(plan, out)
    assert contents(out) == contents(tmp_path / "whole")


def test_share_reads_only_its_records(make_lut: MakeLut, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lut, out, read = make_lut(), tmp_path / "out", set[int]()
    make_share(plan_of(lut), out, (0, 2))
    killed_after(1, lambda: make_share(plan_of(lut), out, (3, 6)))
    pieces = Workplace.pieces

    def recorded(workplace: Workplace, shard: int) -> dict[str, Any]:
        read.add(shard)
        return pieces(workplace, shard)

    monkeypatch.setattr(Workplace, "pieces", recorded)
    assert make_share(plan_of(lut), out, (1, 6)) == (4, 6), "shard 3 has finished images, but is not complete"
    assert read == {1}


def test_refuses_share_after_completion(make_lut: MakeLut, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Its files would stay in the hidden folder, because the data set is already complete.
    lut, out = make_lut(), tmp_path / "out"
    make_dataset(plan_of(lut), tmp_path / "whole")

    def hold_after_completion(*arguments: Any, **named: Any) -> contextlib.AbstractContextManager[FolderLock]:
        (tmp_path / "whole").rename(out)
        return locked_folder(*arguments, **named)

    monkeypatch.setattr("generator.dataset.making.locked_folder", hold_after_completion)
    with pytest.raises(InputError):
        make_share(plan_of(lut), out, (0, 2))
    assert not (tmp_path / ".out.partial").exists()


@pytest.mark.parametrize(("old", "new"), [("24", "25"), ("}\n", "\n"), ("shard\t", "")])
def test_repeats_shard_with_damaged_record(
    make_lut: MakeLut, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, old: str, new: str
) -> None:
    lut, out = make_lut(), tmp_path / "out"
    make_share(plan_of(lut), out, (0, 1))
    (record,) = (tmp_path / ".out.partial" / "plan" / "shards").glob("000001.*")
    record.write_text(record.read_text().replace(old, new))
    counts = counts_of_run(monkeypatch, lambda callbacks: make_dataset(plan_of(lut), out, callbacks=callbacks))
    assert counts == (10, 2, [2, 3])
    make_dataset(plan_of(lut), tmp_path / "whole")
    assert contents(out) == contents(tmp_path / "whole")


def test_reports_picture_changed_between_shares(make_lut: MakeLut, tmp_path: Path) -> None:
    lut, out, folder = make_lut(), tmp_path / "out", tmp_path / "pictures"
    folder.mkdir()
    cv2.imwrite(str(folder / "a.png"), np.full((16, 24, 3), 50, np.uint8))
    plan = Plan(lut, find_pictures(folder), RandomLights(3, 4, 9), 9, DatasetOptions(shard_images=2))
    make_share(plan, out, (0, 2))
    cv2.imwrite(str(folder / "a.png"), np.full((16, 24, 3), 60, np.uint8))
    with pytest.raises(FormatError, match=r"a\.png differs"):
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


def make_and_hash(lut: Lut, pictures: Path, out: Path, options: DatasetOptions, **more_options: Any) -> dict[str, str]:
    """Make a data set under illuminants 1 and 2, and return the hash of every file."""
    generate_dataset(lut, out, find_pictures(pictures), [1, 2], seed=5, options=options, **more_options)
    return contents(out)


def rows_of(out: Path) -> list[dict[str, str]]:
    return list(csv.DictReader((out / "images.csv").read_text().splitlines()))


def test_image_has_random_share_of_black_subtracted(make_lut: MakeLut, pictures: Path, tmp_path: Path) -> None:
    lut = make_lut(bits=3)
    make_and_hash(lut, pictures, tmp_path / "codes", DatasetOptions(previews=False))
    make_and_hash(lut, pictures, tmp_path / "colours", BY_COLOUR)
    by_codes_set, dataset = open_dataset(tmp_path / "codes"), open_dataset(tmp_path / "colours")
    rendering = ColorimetricRendering(lut, MATRIX)
    sources = {source.name: source.read().picture for source in find_pictures(pictures)}
    rows = rows_of(tmp_path / "colours")
    assert dataset.details == {row["image"]: {key: row[key] for key in row if key != "image"} for row in rows}
    for number, (entry, by_codes_entry, row) in enumerate(
        zip(dataset.entries, by_codes_set.entries, rows, strict=True)
    ):
        light = single_mixture(int(entry.lights[0]))
        share = BY_COLOUR.black_point.share(5, number)
        assert row["cells"] == rendering.map.sha256[:16]
        printed = rendering.printed_light(light, share)
        image = draw_printed(lut.samples, sources[entry.source], [printed], rendering.cells, seed=5, image=number)
        np.testing.assert_array_equal(dataset.read_image(entry), np.minimum(image, lut.provenance.white_level))
        assert float(row["black_taken"]) == pytest.approx(share, abs=1e-8)
        assert 0 <= float(row["outside"]) <= 1
        assert float(row["distance"]) >= 0
        assert row["image"] == entry.image
        # The black of the print does not change the ground truth.
        assert (entry.truth, entry.truths) == (by_codes_entry.truth, by_codes_entry.truths)
    description = dataset.description
    assert description.rendering is not None
    pixels = [sources[entry.source].size for entry in dataset.entries]
    for name in ("outside", "distance"):
        mean = np.average([float(row[name]) for row in rows], weights=pixels)
        assert getattr(description.rendering, name) == pytest.approx(mean, abs=1e-6)


def test_existing_data_set_keeps_rendering(make_lut: MakeLut, pictures: Path, tmp_path: Path) -> None:
    lut, out = make_lut(), str(tmp_path / "out")
    wish = (str(lut.folder), out, "--sources", str(pictures), "--light", "1,2", "--seed", "5")
    assert main((*wish, "--rendering", "codes", "--shard", "0/2", "--shard-images", "2")) == 0
    assert main((*wish, "--shard-images", "2")) == 0
    assert open_dataset(out).description.rendering is None
    # A complete data set with equal options is accepted.
    assert main((*wish, "--shard-images", "2")) == 0
    assert main((*wish, "--shard-images", "2", "--rendering", "colorimetric")) == 2


def test_bytes_do_not_depend_on_workers_or_shares(make_lut: MakeLut, pictures: Path, tmp_path: Path) -> None:
    lut = make_lut()
    expected = make_and_hash(lut, pictures, tmp_path / "one", BY_COLOUR, workers=1)
    assert make_and_hash(lut, pictures, tmp_path / "three", BY_COLOUR, workers=3) == expected
    plan = Plan(lut, find_pictures(pictures), ListedLights((1, 2)), 5, BY_COLOUR)
    job = pickle.loads(pickle.dumps(plan.job(0)))
    out = tmp_path / "shares"
    with open_workplace(out, plan.identity(), exclusive=False) as workplace, ThreadPoolExecutor(1) as pool:
        make_shard(job, lut, workplace, pool, 1)
    make_share(plan, out, (0, 1))
    make_dataset(plan, out)
    assert {name: expected[name] for name in ("images.csv", "dataset.json", "images/000003.png")} == {
        name: hashlib.sha256((out / name).read_bytes()).hexdigest()
        for name in ("images.csv", "dataset.json", "images/000003.png")
    }


def test_image_under_several_lights(make_lut: MakeLut, pictures: Path, tmp_path: Path) -> None:
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
        shard_numbers = draw_printed(
            lut.samples,
            source.read().picture,
            lights,
            rendering.cells,
            shares=weights,
            white_level=lut.provenance.white_level,
            seed=5,
            image=number,
        )
        np.testing.assert_array_equal(dataset.read_image(entry), shard_numbers)
        truth = quantised_chromaticities(weights, lighting.whites(lut), FULL) / FULL
        np.testing.assert_allclose(dataset.read_ground_truth_map(entry), truth, atol=2e-5)


def test_subtracts_black_of_mixture(make_lut: MakeLut, pictures: Path, tmp_path: Path) -> None:
    lut = make_lut()
    mixture = Mixture((0, 3), (0.25, 0.75))
    options = DatasetOptions(rendering="codes", black_point=BlackPoint("compensate"))
    request = LightOptions(light=[mixture.label]).choose(lut, 5)
    dataset = generate_dataset(lut, tmp_path / "out", find_pictures(pictures), request, seed=5, options=options)
    picture = next(iter(find_pictures(pictures))).read().picture
    samples = subtract_black(mixture.samples(lut, 5), black_subtraction(lut, mixture, 1.0), lut.provenance.white_level)
    image = dataset.read_image(dataset.entries[0])
    np.testing.assert_array_equal(image, draw_samples(samples, picture, seed=5, image=0))


def test_refuses_invalid_rendering_options() -> None:
    with pytest.raises(InputError):
        DatasetOptions(rendering="codes", matrix=MATRIX)
    with pytest.raises(InputError, match="'inks'"):
        DatasetOptions(rendering="inks")  # pyrefly: ignore[bad-argument-type]


Make = Callable[..., Dataset]


@pytest.fixture
def lut(make_lut: MakeLut) -> Lut:
    """Return a LUT of 512 colours, enough to measure its noise."""
    return make_lut(bits=3)


@pytest.fixture
def smooth_pictures(tmp_path: Path) -> Path:
    """Return a folder of four pictures with smooth colours."""
    folder = tmp_path / "varied_pictures"
    folder.mkdir()
    rng = np.random.default_rng(2)
    for name in "abcd":
        coarse = rng.integers(0, 256, (6, 8, 3)).astype(np.uint8)
        codes = cv2.resize(coarse, (96, 72), interpolation=cv2.INTER_CUBIC)
        (folder / f"{name}.png").write_bytes(cv2.imencode(".png", codes)[1].tobytes())
    return folder


@pytest.fixture
def make_varied(lut: Lut, smooth_pictures: Path, tmp_path: Path) -> Make:
    """Return a function that makes data sets of `smooth_pictures` under two illuminants each."""

    def make_and_hash(
        name: str,
        variation: Variation | None = None,
        crops: int = 1,
        lights: Any = None,
        workers: int = 1,
        **more_options: Any,
    ) -> Dataset:
        preparation = Preparation(crop=(32, 24), crops=crops, seed=5) if crops > 1 else Preparation()
        options = DatasetOptions(
            form="tiff", previews=False, variation=variation, crops=crops, shard_images=3, **more_options
        )
        choice = lights or RandomLights(2, len(lut.white), 5)
        sources = find_pictures(smooth_pictures, preparation)
        return generate_dataset(
            lut, tmp_path / name, sources, choice, seed=5, options=options, workers=Workers(count=workers)
        )

    return make_and_hash


def full_variation(lut: Lut) -> Variation:
    return variation_of(
        lut, parse_exposure("stops:low=-2,high=2"), parse_gradient("smooth:stops=1"), parse_iso("400/100:read=1")
    )


def test_variation_keeps_ground_truths(lut: Lut, make_varied: Make) -> None:
    unvaried, varied = make_varied("plain"), make_varied("varied", full_variation(lut))
    assert [(e.image, e.source, e.lights, e.truths, e.truth) for e in unvaried.entries] == [
        (e.image, e.source, e.lights, e.truths, e.truth) for e in varied.entries
    ]
    assert list(varied.details) == [entry.image for entry in varied.entries]
    names = ["end_r", "end_g", "end_b", "exposure", "iso", "clipped"]
    for entry in varied.entries:
        assert [*varied.details[entry.image]] == ["cells", "outside", "distance", *names]
        row = {name: float(varied.details[entry.image][name]) for name in names}
        assert 0.25 <= row["exposure"] <= 4
        assert row["iso"] == pytest.approx(400)
        # A fall-off is equal in all channels, so it scales the mean of an image.
        first_mean, second_mean = (
            set_.read_image(entry).astype(np.float64).mean(axis=(0, 1)) for set_ in (unvaried, varied)
        )
        if row["clipped"] < 0.001:
            ratio = second_mean / first_mean / row["exposure"]
            assert row["end_g"] - 0.05 < ratio.min()
            assert ratio.max() < 1.05
    assert list(file_faults(varied.store.location)) == []


def test_variation_does_not_depend_on_workers_or_layout(lut: Lut, make_varied: Make, tmp_path: Path) -> None:
    options = {"variation": full_variation(lut), "crops": 2}
    make_varied("one", **options)
    make_varied("three", workers=3, **options)
    assert contents(tmp_path / "one") == contents(tmp_path / "three")
    first = open_dataset(tmp_path / "one")
    for layout in ("webdataset", "parquet"):
        second = make_varied(layout, layout=layout, **options)
        assert second.details == first.details
        for entry, counterpart in zip(first.entries, second.entries, strict=True):
            np.testing.assert_array_equal(first.read_image(entry), second.read_image(counterpart))


def test_clips_requested_share(lut: Lut, make_varied: Make) -> None:
    dataset = make_varied("clipped", variation_of(lut, parse_exposure("clip:share=.05,most=50")))
    white = dataset.description.table.white_level
    for entry in dataset.entries:
        image = dataset.read_image(entry)
        assert image.max() == white
        clipped = (image.max(axis=2) == white).mean()
        assert float(dataset.details[entry.image]["clipped"]) == pytest.approx(clipped, rel=1e-6)
        # The image has 6912 pixels; several may have the count at the limit.
        assert 0.05 <= clipped + 1 / 6912 < 0.06
    # Noise increases the brightest pixels, so it must be included when the factor is chosen.
    noisy = make_varied("noisy", variation_of(lut, parse_exposure("clip:share=.05,most=50"), iso=parse_iso("6400/100")))
    shares = [float(row["clipped"]) for row in noisy.details.values()]
    assert np.abs(np.array(shares) / 0.05 - 1).max() < 0.06
    unclipped = make_varied("unclipped", variation_of(lut, parse_exposure("clip:share=0,most=50")))
    assert all(float(row["clipped"]) == 0 for row in unclipped.details.values())
    assert all(unclipped.read_image(entry).max() >= white - 8 for entry in unclipped.entries)


def test_crops_are_numbered_and_share_a_split(make_varied: Make, smooth_pictures: Path, lut: Lut) -> None:
    dataset = make_varied("crops", crops=3, split=(0.5, 0.2, 0.3))
    assert len(dataset.entries) == 4 * 3 * 2
    assert len(dataset.sources) == 4
    for number, entry in enumerate(dataset.entries):
        row = dataset.details[entry.image]
        assert entry.image == f"{number:06d}.tiff"
        assert (entry.source, int(row["crop"])) == ("abcd"[number // 6] + ".png", number // 2 % 3)
        left, top = int(row["left"]), int(row["top"])
        cut = read_picture(smooth_pictures / entry.source)[top : top + 24, left : left + 32]
        expected = render(lut, np.ascontiguousarray(cut), int(entry.illumination), seed=5, image=number)
        np.testing.assert_array_equal(dataset.read_image(entry), expected)
    # All crops of a picture are in one split and one group of folds.
    splits = {
        entry.source: {other_entry.split for other_entry in dataset.entries if other_entry.source == entry.source}
        for entry in dataset.entries
    }
    assert all(len(counterpart) == 1 for counterpart in splits.values())
    assert {getattr(scene, "group", "") for scene in open_generated(dataset.store.location).scenes} == set(splits)
    # Crops have different illuminants.
    assert (
        len({tuple(entry.illumination for entry in dataset.entries[start : start + 2]) for start in range(0, 24, 2)})
        > 4
    )
    assert dataset.description.pixels == 4 * 3 * 32 * 24


def test_refuses_wrong_number_of_crops(lut: Lut, smooth_pictures: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="has 1 crops, expected 2"):
        generate_dataset(lut, tmp_path / "out", find_pictures(smooth_pictures), [0], options=DatasetOptions(crops=2))


def test_tint_has_correct_maps(lut: Lut, make_varied: Make) -> None:
    gradient = parse_gradient("soft-edge:width=.9,stops=1,least=1,colour=.5")
    dataset = make_varied("tint", variation_of(lut, gradient=gradient))
    unvaried = make_varied("plain")
    scenes = open_generated(dataset.store.location).scenes
    for entry, flat, scene in zip(dataset.entries, unvaried.entries, scenes, strict=True):
        row = dataset.details[entry.image]
        end = np.array([float(row[f"end_{channel}"]) for channel in "rgb"])
        light = int(entry.illumination)
        assert entry.lights == (str(light), str(light))
        np.testing.assert_allclose(entry.truths[0], lut.ground_truth[light], atol=1e-9)
        weights = dataset.read_weights(entry).astype(np.float64)
        mixed_rgb = weights @ np.array([lut.white[light], lut.white[light] * end])
        np.testing.assert_allclose(
            dataset.read_ground_truth_map(entry), mixed_rgb / mixed_rgb.sum(axis=2, keepdims=True), atol=2e-5
        )
        mean = mixed_rgb.mean(axis=(0, 1))
        np.testing.assert_allclose(entry.truth, mean / mean.sum(), atol=1e-7)
        # The image is the unvaried one, scaled by the illuminant in the map.
        ratio = dataset.read_image(entry) / np.maximum(unvaried.read_image(flat), 1.0) / (mixed_rgb / lut.white[light])
        assert np.abs(np.median(ratio, axis=(0, 1)) - 1).max() < 0.01
        assert isinstance(scene, MixedScene)


def test_falloff_weights_ground_truth(lut: Lut, make_varied: Make) -> None:
    choice = SimultaneousLights(RandomLights(2, len(lut.white), 5), 2, parse_masks("half-plane:angle=0", 2, 5))
    gradient = variation_of(lut, gradient=parse_gradient("soft-edge:angle=0,width=.9,stops=3,least=3"))
    dataset = make_varied("several", gradient, lights=choice)
    unvaried = make_varied("plain", lights=choice)
    largest_difference = 0.0
    for entry, flat in zip(dataset.entries, unvaried.entries, strict=True):
        weights = dataset.read_weights(entry).astype(np.float64)
        np.testing.assert_array_equal(weights, unvaried.read_weights(flat))
        falloff = parse_gradient("soft-edge:angle=0,width=.9,stops=3,least=3").of_image(5, int(entry.image[:6]))
        level = 1 - falloff.weights(*weights.shape[:2])[..., 1] * (1 - falloff.end[0])
        mean = (weights * level[..., None]).mean(axis=(0, 1)) @ lut.white[[int(light) for light in entry.lights]]
        np.testing.assert_allclose(entry.truth, mean / mean.sum(), atol=1e-6)
        largest_difference = max(largest_difference, np.abs(np.subtract(entry.truth, flat.truth)).max())
    # Without the weights of the fall-off, the ground truth would not change.
    assert largest_difference > 0.001


def test_refuses_tint_with_several_lights(lut: Lut, make_varied: Make) -> None:
    choice = SimultaneousLights(RandomLights(2, len(lut.white), 5), 2, parse_masks("smooth", 2, 5))
    with pytest.raises(InputError):
        make_varied("both", variation_of(lut, gradient=parse_gradient("smooth:colour=.1")), lights=choice)


def test_raw_files_have_equal_counts(lut: Lut, make_varied: Make, smooth_pictures: Path, tmp_path: Path) -> None:
    variation = full_variation(lut)
    options = DatasetOptions(form="dng", previews=False, variation=variation)
    raw = generate_dataset(
        lut,
        tmp_path / "raw",
        find_pictures(smooth_pictures),
        RandomLights(2, 4, 5),
        seed=5,
        options=options,
    )
    unvaried = make_varied("tiff", variation)
    assert raw.details == {name.replace("tiff", "dng"): row for name, row in unvaried.details.items()}
    for raw_entry, tiff_entry in zip(raw.entries, unvaried.entries, strict=True):
        halved, image = raw.read_image(raw_entry), unvaried.read_image(tiff_entry)
        np.testing.assert_array_equal(halved[..., 0], image[0::2, 0::2, 0])
        np.testing.assert_array_equal(halved[..., 2], image[1::2, 1::2, 2])
