"""The examples of the documentation do what they say."""

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
def test_the_lines_of_the_page_for_programmers() -> None:
    blocks = re.findall(r"(?:^    .*\n)+", (ROOT / "docs" / "library.md").read_text(), re.MULTILINE)
    assert len(blocks) == 3
    assert len(blocks[0].splitlines()) == 3
    names: dict[str, Any] = {}
    for block in blocks:
        exec(textwrap.dedent(block), names)
    raw, lut = names["raw"], names["lut"]
    assert (raw.dtype, raw.shape) == (np.uint16, (40, 50, 3))
    by_codes = names["render"](lut, names["read_picture"]("cat.png"), light=3, rendering="codes", seed=1)
    assert {tuple(one) for one in by_codes.reshape(-1, 3)} <= {tuple(row) for row in lut.samples[3].reshape(-1, 3)}
    assert sum(names["truth"]) == pytest.approx(1)
    assert names["balanced"].max() == 1
    assert names["image"].shape == (40, 50, 3)
    assert names["made"].description.images == 2
    assert names["entry"].truth == pytest.approx(tuple(lut.ground_truth[3]), abs=1e-9)


@pytest.mark.usefixtures("table_and_picture")
def test_a_table_is_one_line() -> None:
    shown = repr(open_lut("lut"))
    assert shown.startswith("Lut('lut'")
    assert len(shown) < 150
    assert repr(gallery_of([np.zeros((4, 4, 3), np.uint8)] * 99)) == "Gallery of 99 pictures"


@pytest.mark.usefixtures("table_and_picture")
def test_lights_are_named_as_on_the_command_line() -> None:
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
        generate_dataset(lut, place, find_pictures("cat.png"), lights)
        for place, lights in (("texts", ["3", "0:0.5+3:0.5"]), ("numbers", [3]))
    )
    assert repr(texts) == "Dataset('texts', 2 images, layout folder)"
    assert [entry.lights for entry in texts.entries] == [("3",), ("0:0.5+3:0.5",)]
    assert np.array_equal(texts.read_image(texts.entries[0]), numbers.read_image(numbers.entries[0]))


@pytest.mark.usefixtures("table_and_picture")
def test_wrong_arguments_are_answered_with_what_is_expected() -> None:
    lut, picture = open_lut("lut"), read_picture("cat.png")
    gallery = gallery_of([picture])
    wrong: list[tuple[Callable[..., Any], tuple[Any, ...], dict[str, Any], str]] = [
        (render, (picture, lut, 3), {}, "open_lut"),
        (render, ("lut", picture, 3), {}, "the text 'lut', expected a Lut"),
        (render, (lut, "cat.png", 3), {}, r"the text 'cat.png', expected an array uint8"),
        (render, (lut, picture / 255, 3), {}, "float64"),
        (render, (lut, picture, 2.5), {}, "2.5 is no illuminant"),
        (Crops, ("lut", gallery), {}, "open_lut"),
        (Crops, (lut, [picture], (8, 8)), {}, "gallery_of"),
        (Crops, (lut, gallery, 8), {}, "height and width"),
        (Crops, (lut, gallery, (8, 8)), {"lights": 3}, "a list"),
        (Crops, (lut, gallery, (8, 8)), {"lights": ["D66"]}, "'D66' is no light"),
        (Crops, (lut, gallery, (8, 8)), {"black_point": "rnd"}, "'rnd'"),
        (Crops, (lut, gallery, (8, 8)), {"black_point": 0.5}, "'compensate'"),
        (generate_dataset, (lut, "out", find_pictures("cat.png"), "D65"), {}, "the text 'D65', expected a list"),
        (generate_dataset, (lut, "out", find_pictures("cat.png"), ["D66"]), {}, "'D66' is no light"),
        (gallery_of, ("cat.png",), {}, "the text 'cat.png'"),
        (gallery_of, (["cat.png"],), {}, "read_picture"),
    ]
    for function, given, options, told in wrong:
        with pytest.raises(InputError, match=told):
            function(*given, **options)


@pytest.mark.usefixtures("table_and_picture")
def test_the_array_of_jobs() -> None:
    script = ROOT / "examples" / "slurm" / "generate.sbatch"
    job = {"SLURM_ARRAY_TASK_ID": "0", "SLURM_ARRAY_TASK_COUNT": "1", "SLURM_CPUS_PER_TASK": "1"}
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", script, "lut", "out", "--sources", "cat.png"],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, **job, "PATH": path},
    )
    assert done.returncode == 0, done.stderr
    assert "1 of 1 shards of out are done; run the same command without --shard" in done.stdout
