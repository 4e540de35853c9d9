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

from evaluation.datasets import open_scenes
from evaluation.metrics import summarise
from evaluation.results.result import Result
from foundation.errors import InputError
from generator import (
    Callbacks,
    DatasetOptions,
    Workers,
    draw_batch,
    draw_samples,
    find_pictures,
    generate_dataset,
    mix_samples,
    mixed_table,
    open_lut,
    read_picture,
    render,
)
from generator.lights.choices import SimultaneousLights
from generator.lights.lighting import ListedLights
from generator.masks.making import parse_masks
from generator.rendering import Rendering
from generator.rendering.matrices import matrix_for
from generator.training import Crops, gallery_of

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]


@pytest.mark.usefixtures("table_and_picture")
def test_examples_of_library_page() -> None:
    blocks = re.findall(r"(?:^    .*\n)+", (ROOT / "docs" / "library.md").read_text(), re.MULTILINE)
    assert len(blocks) == 4
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
    assert (names["mixed"][:, 0] == render(lut, names["picture"], light=0)[:, 0]).all()
    assert names["image"].shape == (40, 50, 3)
    assert names["made"].description.images == 2
    assert names["entry"].truth == pytest.approx(tuple(lut.ground_truth[3]), abs=1e-9)


@pytest.mark.usefixtures("table_and_picture")
def test_repr_is_short() -> None:
    text = repr(open_lut("lut"))
    assert text.startswith("Lut('lut'")
    assert len(text) < 150
    lut, gallery = open_lut("lut"), gallery_of([np.zeros((4, 4, 3), np.uint8)] * 99)
    crops = Crops(lut, gallery, (4, 4), length=9)
    dataset = generate_dataset(lut, "short", find_pictures("cat.png"), [0, 1])
    scenes = open_scenes("short")
    result = Result("Mine", np.eye(3), {"recovery": np.ones(3)}, np.zeros(3, bool))
    assert repr(gallery) == "Gallery of 99 pictures"
    assert repr(crops.batch([0])) == "Batch(1 crop of 4x4 px)"
    assert repr(crops).startswith("Crops(9 crops of 4x4 px, 4 illuminants, Gallery of 99 pictures, Lut('lut'")
    assert repr(scenes) == "SceneSet('short', 2 images, layout generated)"
    assert repr(result) == "Result('Mine', 3 images)"
    objects = (
        lut,
        lut.provenance,
        *lut.illuminations,
        matrix_for(lut),
        crops,
        dataset,
        *dataset.entries,
        *scenes.scenes,
    )
    for shown in (*objects, DatasetOptions(), Callbacks(), Workers(), summarise([1, 2])):
        assert len(repr(shown)) < 300, repr(shown)
        assert "\n" not in repr(shown)


@pytest.mark.usefixtures("table_and_picture")
@pytest.mark.parametrize("rendering", get_args(Rendering))
def test_renders_several_lights_like_a_data_set(rendering: Rendering) -> None:
    lut = open_lut("lut")
    lights = SimultaneousLights(ListedLights((1, 3)), 2, parse_masks("soft-edge", 2, 4))
    options = DatasetOptions(rendering=rendering)
    dataset = generate_dataset(lut, f"mixed-{rendering}", find_pictures("cat.png"), lights, seed=4, options=options)
    weights, image = dataset.read_weights(dataset.entries[0]), dataset.read_image(dataset.entries[0])
    picture, labels = read_picture("cat.png"), dataset.entries[0].lights
    drawn = render(lut, picture, lights=labels, weights=weights, rendering=rendering, seed=4)
    np.testing.assert_array_equal(drawn, image)
    # The same weights in other forms; powers of two scale exactly.
    for same in (weights.astype(">f8"), np.asfortranarray(weights, np.longdouble), weights.astype(">f4") * 2.0**99):
        again = render(lut, picture, lights=labels, weights=same, rendering=rendering, seed=4)
        np.testing.assert_array_equal(again, image)
    one = render(lut, picture, lights=labels[:1], weights=weights[..., :1] + 1, rendering=rendering, seed=4)
    np.testing.assert_array_equal(one, render(lut, picture, labels[0], rendering=rendering, seed=4))


@pytest.mark.usefixtures("table_and_picture")
def test_refuses_invalid_weights() -> None:
    lut, picture = open_lut("lut"), read_picture("cat.png")
    weights = np.ones((*picture.shape[:2], 2))
    for pixel, text in (([np.nan, 1], "nan"), ([np.inf, 1], "inf"), ([-1, 2], "-1.0"), ([0, 0], "0.0, 0.0")):
        changed = weights.copy()
        changed[3, 5] = pixel
        with pytest.raises(InputError, match=f"row 3, column 5 are .*{text}"):
            render(lut, picture, lights=[0, 1], weights=changed)
    for wrong in (weights[..., 0], weights.transpose(2, 0, 1), weights.astype(complex), weights.astype(object), "map"):
        with pytest.raises(InputError, match=r"expected numbers of shape \(40, 50, 2\)"):
            render(lut, picture, lights=[0, 1], weights=wrong)
    with pytest.raises(InputError, match="2 illuminants have no weights"):
        render(lut, picture, lights=[0, 1])
    with pytest.raises(InputError, match="lights is empty"):
        render(lut, picture, lights=[], weights=weights)
    for light, lights in ((None, None), (0, [0])):
        with pytest.raises(InputError, match="expected one of them"):
            render(lut, picture, light, lights=lights)


@pytest.mark.usefixtures("table_and_picture")
def test_kernels_read_samples_and_weights_of_any_byte_order() -> None:
    lut, picture = open_lut("lut"), read_picture("cat.png")
    samples = np.array(lut.samples[:2])
    swapped = samples.astype(">u2")
    weights = np.random.default_rng(1).random((*picture.shape[:2], 2), np.float32)
    windows, level = [(0, 0, 8, 8)], lut.provenance.white_level
    for first, second in (
        (draw_samples(samples[0], picture), draw_samples(swapped[0], picture)),
        (mix_samples(samples, picture, weights), mix_samples(swapped, picture, weights.astype(">f8"))),
        (mixed_table(samples, [0.5, 0.5]), mixed_table(swapped, np.array([0.5, 0.5], ">f4"))),
        (
            draw_batch(samples, [1], [picture], windows, white_level=level),
            draw_batch(swapped, [1], [picture], windows, white_level=level),
        ),
    ):
        np.testing.assert_array_equal(first, second)


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
