"""The examples of the documentation."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest

from foundation.errors import InputError
from generator import find_pictures, generate_dataset, open_lut, read_picture, render
from generator.rendering import Rendering
from generator.training import Crops, gallery_of

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]


@pytest.mark.usefixtures("table_and_picture")
def test_examples_of_library_page() -> None:
    blocks = re.findall(r"(?:^    .*\n)+", (ROOT / "docs" / "library.md").read_text(), re.MULTILINE)
    assert len(blocks) == 3
    assert len(blocks[0].splitlines()) == 3
    names: dict[str, Any] = {}
    for block in blocks:
        exec(textwrap.dedent(block), names)
    raw, lut = names["raw"], names["lut"]
    assert (raw.dtype, raw.shape) == (np.uint16, (40, 50, 3))
    by_codes = names["render"](lut, names["read_picture"]("cat.png"), light=3, rendering="codes", seed=1)
    assert {tuple(sample) for sample in by_codes.reshape(-1, 3)} <= {
        tuple(row) for row in lut.samples[3].reshape(-1, 3)
    }
    assert sum(names["truth"]) == pytest.approx(1)
    assert names["balanced"].max() == 1
    assert names["image"].shape == (40, 50, 3)
    assert names["made"].description.images == 2
    assert names["entry"].truth == pytest.approx(tuple(lut.ground_truth[3]), abs=1e-9)


@pytest.mark.usefixtures("table_and_picture")
def test_repr_is_short() -> None:
    text = repr(open_lut("lut"))
    assert text.startswith("Lut('lut'")
    assert len(text) < 150
    assert repr(gallery_of([np.zeros((4, 4, 3), np.uint8)] * 99)) == "Gallery of 99 pictures"


@pytest.mark.usefixtures("table_and_picture")
def test_accepts_lights_as_texts() -> None:
    lut, picture = open_lut("lut"), read_picture("cat.png")
    for rendering in get_args(Rendering):
        plain = render(lut, picture, 3, rendering=rendering, seed=1)
        assert np.array_equal(render(lut, picture, "3", rendering=rendering, seed=1), plain)
        mixed = render(lut, picture, "0:0.5+3:0.5", rendering=rendering, seed=1)
        assert not np.array_equal(mixed, plain)
    gallery = gallery_of([picture])
    crops = Crops(lut, gallery, (8, 8), lights=["3", 0, "0:0.5+3:0.5"], black_point="random")
    assert [light.label for light in crops.lights] == ["3", "0", "0:0.5+3:0.5"]
    assert crops.black_point.kind == "random"
    with pytest.raises(InputError, match="write 5200K"):
        render(lut, picture, "daylight")
    texts, numbers = (
        generate_dataset(lut, out, find_pictures("cat.png"), lights)
        for out, lights in (("texts", ["3", "0:0.5+3:0.5"]), ("numbers", [3]))
    )
    assert repr(texts) == "Dataset('texts', 2 images, layout folder)"
    assert [entry.lights for entry in texts.entries] == [("3",), ("0:0.5+3:0.5",)]
    assert np.array_equal(texts.read_image(texts.entries[0]), numbers.read_image(numbers.entries[0]))


@pytest.mark.usefixtures("table_and_picture")
def test_reports_expected_arguments() -> None:
    lut, picture = open_lut("lut"), read_picture("cat.png")
    gallery = gallery_of([picture])
    calls: list[tuple[Callable[..., Any], tuple[Any, ...], dict[str, Any], str]] = [
        (render, (picture, lut, 3), {}, "open_lut"),
        (render, ("lut", picture, 3), {}, "the text 'lut', expected a Lut"),
        (render, (lut, "cat.png", 3), {}, r"the text 'cat.png', expected an array uint8"),
        (render, (lut, picture / 255, 3), {}, "float64"),
        (render, (lut, picture, 2.5), {}, "2.5 is not an illuminant"),
        (Crops, ("lut", gallery), {}, "open_lut"),
        (Crops, (lut, [picture], (8, 8)), {}, "gallery_of"),
        (Crops, (lut, gallery, 8), {}, "height and width"),
        (Crops, (lut, gallery, (8, 8)), {"lights": 3}, "a list"),
        (Crops, (lut, gallery, (8, 8)), {"lights": ["D66"]}, "'D66' is not an illuminant"),
        (Crops, (lut, gallery, (8, 8)), {"black_point": "rnd"}, "'rnd'"),
        (Crops, (lut, gallery, (8, 8)), {"black_point": 0.5}, "'compensate'"),
        (generate_dataset, (lut, "out", find_pictures("cat.png"), "D65"), {}, "the text 'D65', expected a list"),
        (generate_dataset, (lut, "out", find_pictures("cat.png"), ["D66"]), {}, "'D66' is not an illuminant"),
        (gallery_of, ("cat.png",), {}, "the text 'cat.png'"),
        (gallery_of, (["cat.png"],), {}, "read_picture"),
    ]
    for function, arguments, options, message in calls:
        with pytest.raises(InputError, match=message):
            function(*arguments, **options)


@pytest.mark.usefixtures("table_and_picture")
def test_slurm_job_array() -> None:
    script = ROOT / "examples" / "slurm" / "generate.sbatch"
    job = {"SLURM_ARRAY_TASK_ID": "0", "SLURM_ARRAY_TASK_COUNT": "1", "SLURM_CPUS_PER_TASK": "1"}
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    process = subprocess.run(
        ["bash", script, "lut", "out", "--sources", "cat.png"],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, **job, "PATH": path},
    )
    assert process.returncode == 0, process.stderr
    assert "1 of 1 shards of out are done; run the same command without --shard" in process.stdout
