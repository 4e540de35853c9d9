"""Data sets with all kinds of illuminants, masks, variations and layouts equal those of earlier versions."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import chdir
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from foundation.errors import CropError
from generator.cli import main
from generator.dataset.reader import file_faults, open_dataset
from tests.generator.dataset.known import data_set_content, table_in
from tests.pinned import Pinned

pytestmark = pytest.mark.slow

RUNS = {
    "all lights of the table": "--light all --rendering codes --no-preview --split 2,1",
    "listed lights": "--light 0,2-3 --rendering codes --split .5,.25,.25",
    "random lights": "--random 3 --rendering codes --format tiff --shard-images 4",
    "mixed lights": "--light 1 --light 0:0.25+3:0.75 --light 5600K --light E --light r=.32,b=.3 --rendering "
    "codes --uncertainty",
    "lights drawn evenly": "--distribution uniform --random 3 --rendering codes --format exr",
    "lights drawn from a bell": "--distribution gaussian:r=.32,b=.28,sd_r=.03,sd_b=.02,corr=-.6 --random 2 "
    "--rendering codes",
    "lights drawn like a file's": "--distribution truths.csv --random 3 --rendering codes",
    "nearest lights": "--nearest truths.csv --rendering codes --format dng",
    "matched lights": "--match truths.csv --rendering codes --format jxl",
    "two lights of half-planes": "--masks half-plane:angle=30 --rendering codes --uncertainty",
    "three lights with soft edges": "--masks soft-edge:width=.4 --lights-per-image 3 --rendering codes",
    "four lights in spots": "--masks spots:count=2,radius=.3,softness=.2 --lights-per-image 4 --rendering codes",
    "two lights of smooth fields": "--masks smooth:scale=.2,contrast=4 --random 2 --rendering codes",
    "three lights through a window": "--masks window:columns=3,rows=1,softness=.02 --lights-per-image 3 --rendering "
    "codes --layout parquet",
    "masks of a folder": "--masks masks --lights-per-image 2 --light 0 --light 3 --rendering codes",
    "a fixed exposure": "--exposure .37 --rendering codes --light 1",
    "stops and speed": "--exposure stops:low=-2,high=1 --iso 1600:read=3 --rendering codes --random 2",
    "clipped shares under a gradient": "--exposure clip:share=.05,most=20 --gradient spots:count=1,stops=2,least=1 "
    "--rendering codes",
    "levels with a tint": "--exposure level:share=.02,low=.3,high=.9 --gradient smooth:colour=.4,stops=1.5 --iso "
    "800/100 --rendering codes --uncertainty",
    "normal exposures and soft edges": "--exposure normal:mean=-1,sd=.6 --gradient soft-edge:width=.5,stops=3 "
    "--rendering codes --layout webdataset --split .6,.2,.2",
    "crops": "--crop 13x12,cover --crops 3 --rendering codes --sources small --split .5,.5",
    "small crops in the centre": "--max-side 24 --crop 17x11 --rendering codes --sources small",
    "random crops": "--crop 20x9,random --rendering codes --sources small --split 1,1",
    "colours without black": "--black-point random:.8 --random 2",
    "colours of two lights": "--black-point compensate --masks smooth --random 1 --exposure .5",
    "codes without black": "--black-point compensate --rendering codes --light 0,3",
    "codes without black of two lights": "--black-point random --rendering codes --masks window",
    "colours by a camera's matrix": "--matrix matrix.txt --light 2 --layout parquet --gradient window:stops=1",
    "colours without a matrix": "--matrix none --light 2 --split .4,.3,.3 --black-point random",
}


def picture(name: str, height: int, width: int, seed: int) -> None:
    """Write a picture of a colour gradient with noise, and a corner of one colour."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:height, :width]
    ramp = np.stack([255 * x / width, 255 * y / height, 255 - 255 * x / width], axis=-1)
    codes = np.clip(ramp + rng.normal(0, 20, ramp.shape), 0, 255).astype(np.uint8)
    codes[: height // 4, : width // 4] = (seed % 256, 0, 255)
    Path(name).parent.mkdir(exist_ok=True)
    Path(name).write_bytes(cv2.imencode(".png", codes)[1].tobytes())


@pytest.fixture(scope="module", autouse=True)
def work_folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Change to a folder with a LUT, pictures of odd and even sizes, masks, and lists of illuminants."""
    folder = tmp_path_factory.mktemp("known")
    with chdir(folder):
        table_in(Path("lut"))
        picture("cat.png", 33, 26, 7)
        picture("small/a.png", 21, 34, 8)
        picture("small/b.png", 40, 19, 9)
        picture("small/c.png", 9, 8, 10)
        Path("masks").mkdir()
        Path("masks/one.png").write_bytes(
            cv2.imencode(".png", np.arange(48, dtype=np.uint8).reshape(6, 8))[1].tobytes()
        )
        Path("truths.csv").write_text("GT_R,GT_G,GT_B\n.4,.36,.24\n.3,.36,.34\n.35,.39,.26\n.2,.5,.3\n", "utf-8")
        Path("matrix.txt").write_text(".6 .3 .1\n.1 .7 .2\n.05 .25 .7\n")
        yield folder


@pytest.mark.parametrize("name", RUNS)
def test_dataset(name: str, work_folder: Path, pinned: Pinned) -> None:
    words = RUNS[name].split()
    if "--sources" not in words:
        words += ["--sources", "cat.png", "--random-scenes", "1:21x16"]
    out = work_folder / name.replace(" ", "-")
    assert main(["lut", out.name, *words, "--seed", "5", "--workers", "1"]) in (0, 1)
    pinned(f"dataset, {name}", data_set_content(out))


def test_illuminants_of_other_data_set(work_folder: Path, pinned: Pinned, capsys: pytest.CaptureFixture[str]) -> None:
    table_in(work_folder / "other", order=(3, 1, 0, 2))
    first = "--sources small --random-scenes 2:9x7 --seed 6 --max-side 30 --rendering codes"
    results: dict[str, Any] = {}
    for name, lights in (
        ("single", "--light 0,3"),
        ("mixed", "--light 0:.3+2:.7"),
        ("masks", "--lights-per-image 2 --light 0 --light 2"),
    ):
        lights += " --gradient smooth:stops=1" if name == "single" else ""
        assert main(f"lut first-{name} {first} {lights}".split()) == 0
        for table in ("lut", "other") if name == "single" else ("other",):
            words = f"{table} again-{name}-{table} --lights-of first-{name} --sources small --rendering codes"
            code = main(words.split())
            repeated = work_folder / f"again-{name}-{table}"
            results[f"{name} {table}"] = {"failed": code} if code else data_set_content(repeated)
    pinned("datasets under the lights of others", results)


def test_data_set_in_parts(work_folder: Path, pinned: Pinned, capsys: pytest.CaptureFixture[str]) -> None:
    plan = "lut shares --random-scenes 7:12x9 --random 2 --rendering codes --seed 1 --shard-images 3"
    results: list[Any] = []

    def run(words: str) -> None:
        results.append([main([*words.split(), "--json"]), *printed_json(capsys)])

    for words in (f"{plan} --shard 0/2", f"{plan} --shard 2/2", f"{plan} --shard 1/2", plan, plan):
        run(words)
    run("--verify shares")
    results.append(data_set_content(work_folder / "shares"))
    (work_folder / "shares/images/000003.png").write_bytes(b"1")
    (work_folder / "shares/images/000004.png").unlink()
    (work_folder / "shares/new.txt").touch()
    run("--verify shares")
    pinned("a dataset in shares", results)


def printed_json(capsys: pytest.CaptureFixture[str]) -> list[Any]:
    """Return the printed object without the speed."""
    printed = json.loads(capsys.readouterr().out or "{}")
    return [printed]


DAMAGES: dict[str, list[tuple[str, str]]] = {
    "gt.txt": [
        ("0.", "1."),
        ("\n", "\n\n"),
        (" ", ","),
        ("0.5", "0.500003"),
        ("0.543478261", "0.543480"),
        ("0.543478261", "0.5434797"),
        ("1\n", "1 1\n"),
    ],
    "ground_truth.csv": [
        (",0,", ",9,"),
        ("000001", "000009"),
        ("000000", "x"),
        ("illumination", "light"),
        ("0.5", "nan"),
    ],
    "dataset.json": [
        ('"version": 2', '"version": 9'),
        ('"images": 2', '"images": 3'),
        ('"seed"', '"sead"'),
        ("{", "["),
    ],
    "sources.csv": [("width", "wide"), (",9,8,", ",9,eight,"), (",9,8,", ",9,-8,")],
    "SHA256SUMS": [("  ", " "), ("gt.txt", "../gt.txt"), ("gt.txt", "sources.csv"), ("gt.txt", "none.txt")],
    "images/000001.png": [("IHDR", "IHDS"), ("IDAT", "IDAX"), ("IEND", "")],
}


def test_damaged_datasets(work_folder: Path, pinned: Pinned) -> None:
    plan = "lut damaged --random-scenes 2:9x8 --rendering codes --light 0 --no-preview"
    assert main(plan.split()) == 0
    results: dict[str, Any] = {}
    for name, changes in DAMAGES.items():
        path = work_folder / "damaged" / name
        intact = path.read_bytes()
        for old, new in changes:
            path.write_bytes(intact.replace(old.encode(), new.encode(), 1))
            outcome: list[Any] = []
            try:
                outcome.append(len(list(file_faults(work_folder / "damaged"))))
                dataset = open_dataset(work_folder / "damaged")
                outcome += [
                    [entry.image, entry.truth, dataset.read_image(entry).tobytes()] for entry in dataset.entries
                ]
                outcome.append(len(dataset.sources))
            except CropError:
                outcome.append({"refused": 1})
            results[f"{name} {old!r} {new!r}"] = outcome
        path.write_bytes(intact)
    pinned("damaged datasets", results)
