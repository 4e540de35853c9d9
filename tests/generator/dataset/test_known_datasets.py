"""Datasets of every kind of light, mask, variation, rendering, layout and part, as the command made them before."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import chdir
from pathlib import Path

import cv2
import numpy as np
import pytest

from generator.cli import main
from tests.generator.dataset.known import held_by, table_in
from tests.pinned import Pinned

pytestmark = pytest.mark.slow

RUNS = {
    "all lights of the table": "--illuminations all --rendering codes --no-preview --split 2,1",
    "listed lights and an exact split": "--illuminations 0,2-3 --rendering codes --split .5,.25,.25 --exact-split",
    "random lights": "--random 3 --rendering codes --format tiff --scale full --shard-images 4",
    "mixed lights": "--light 1 --light 0:0.25+3:0.75 --light 5600K --light E --light r=.32,b=.3 --rendering codes --uncertainty",
    "lights drawn evenly": "--distribution uniform --random 3 --rendering codes --format exr --bits 1",
    "lights drawn from a bell": "--distribution gaussian:r=.32,b=.28,sd_r=.03,sd_b=.02,corr=-.6 --random 2 --outside "
    "nearest --rendering codes",
    "lights drawn like a file's": "--distribution truths.csv --random 3 --outside nearest --rendering codes",
    "nearest lights": "--nearest truths.csv --rendering codes --format dng",
    "matched lights": "--match truths.csv --outside nearest --rendering codes --format jxl",
    "lights by name": "--lights-by-name named.csv --outside nearest --rendering codes --sources small",
    "two lights of half-planes": "--masks half-plane:angle=30 --rendering codes --uncertainty",
    "three lights with soft edges": "--masks soft-edge:width=.4 --lights-per-image 3 --rendering codes",
    "four lights in spots": "--masks spots:count=2,radius=.3,softness=.2 --lights-per-image 4 --rendering codes",
    "two lights of smooth fields": "--masks smooth:scale=.2,contrast=4 --random 2 --rendering codes",
    "three lights through a window": "--masks window:columns=3,rows=1,softness=.02 --lights-per-image 3 --rendering "
    "codes --layout parquet",
    "masks of a folder": "--masks masks --lights-per-image 2 --light 0 --light 3 --rendering codes",
    "a fixed exposure": "--exposure .37 --rendering codes --illuminations 1",
    "stops and speed": "--exposure stops:low=-2,high=1 --iso 1600:read=3 --rendering codes --random 2",
    "clipped shares under a gradient": "--exposure clip:share=.05,most=20 --gradient spots:count=1,stops=2,least=1 "
    "--rendering codes",
    "levels with a tint": "--exposure level:share=.02,low=.3,high=.9 --gradient smooth:colour=.4,stops=1.5 --iso "
    "800/100 --rendering codes --uncertainty",
    "normal exposures and soft edges": "--exposure normal:mean=-1,sd=.6 --gradient soft-edge:width=.5,stops=3 "
    "--rendering codes --layout webdataset --split .6,.2,.2",
    "crops": "--crop 13x12 --crops 3 --cover --rendering codes --sources small --split .5,.5",
    "small crops in the centre": "--max-side 24 --crop 17x11 --crop-at centre --rendering codes --sources small",
    "random crops": "--crop 20x9 --crop-at random --profiles ignore --rendering codes --sources small --split 1,1",
    "colours without black": "--black-point random:.8 --random 2",
    "colours of two lights": "--black-point compensate --masks smooth --random 1 --exposure .5",
    "codes without black": "--black-point compensate --rendering codes --illuminations 0,3",
    "codes without black of two lights": "--black-point random --rendering codes --masks window",
    "colours by a camera's matrix": "--matrix matrix.txt --illuminations 2 --layout parquet --gradient window:stops=1",
    "colours without a matrix": "--matrix none --illuminations 2 --split .4,.3,.3 --black-point random",
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
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Go to a folder with a table, pictures of odd and even sizes, masks, and lists of lights."""
    folder = tmp_path_factory.mktemp("known")
    with chdir(folder):
        table_in(Path("lut"))
        picture("cat.png", 33, 26, 7)
        picture("small/a.png", 21, 34, 8)
        picture("small/b.png", 40, 19, 9)
        picture("small/c.png", 9, 8, 10)
        os.mkdir("masks")
        Path("masks/one.png").write_bytes(
            cv2.imencode(".png", np.arange(48, dtype=np.uint8).reshape(6, 8))[1].tobytes()
        )
        Path("truths.csv").write_text("GT_R,GT_G,GT_B\n.4,.36,.24\n.3,.36,.34\n.35,.39,.26\n.2,.5,.3\n", "utf-8")
        Path("named.csv").write_text("name,r,g,b\na.png,.42,.35,.23\nb.png,.3,.35,.35\nc.png,.3,.45,.25\n")
        Path("matrix.txt").write_text(".6 .3 .1\n.1 .7 .2\n.05 .25 .7\n")
        yield folder


@pytest.mark.parametrize("name", RUNS)
def test_a_dataset(name: str, place: Path, pinned: Pinned, capsys: pytest.CaptureFixture[str]) -> None:
    words = RUNS[name].split()
    if "--sources" not in words:
        words += ["--sources", "cat.png", "--random-scenes", "1", "--size", "21x16"]
    out = place / name.replace(" ", "-")
    assert main(["lut", out.name, *words, "--seed", "5", "--workers", "1"]) in (0, 1)
    pinned(f"dataset, {name}", {"said": capsys.readouterr().out, **held_by(out)})
