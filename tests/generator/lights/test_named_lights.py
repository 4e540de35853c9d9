"""From options, and from files that name pictures, to a choice of lights."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest

from foundation.errors import CropError, FormatError, InputError
from generator.lights.choices import SequentialLights
from generator.lights.gamut import Gamut
from generator.lights.lighting import plain
from generator.lights.named_lights import load_named_truths, named_lights
from generator.options import LightOptions
from tests.generator.conftest import MakeLut


def written(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def test_each_picture_gets_the_light_of_its_name(make_lut: MakeLut, tmp_path: Path) -> None:
    lut = make_lut()
    wanted = {f"more/{name}.png": lut.white[[0, 3]].mean(axis=0) * scale for name, scale in (("a", 1), ("b", 7))}
    wanted["c.png"] = lut.white[1]
    rows = [f"x,{name},{light[0]},{light[1]},{light[2]}\n" for name, light in wanted.items()]
    path = written(tmp_path / "gt.csv", "image,source,r,g,b\n" + "".join(rows))
    request = LightOptions(lights_by_name=path)
    names = ["c.png", "more/b.png", "more/a.png"]
    choice = request.choose(lut, 1, names)
    assert choice.lights_each == 1
    for position, name in enumerate(names):
        (lighting,) = choice.lightings_of(position)
        white = lighting.whites(lut)[0]
        np.testing.assert_allclose(white / white.sum(), wanted[name] / wanted[name].sum(), atol=1e-6)
    # In the world where lights go by their order, the first picture would have that of the file's first row.
    by_order = LightOptions(match=path).choose(lut, 1, names).lightings_of(0)
    assert by_order != choice.lightings_of(0)
    assert pickle.loads(pickle.dumps(choice)).lightings_of(2) == choice.lightings_of(2)
    crops = request.choose(lut, 1, names, crops=3)
    assert [crops.lightings_of(scene) for scene in range(9)] == [choice.lightings_of(scene // 3) for scene in range(9)]


def test_names_with_other_suffixes_and_several_lights(make_lut: MakeLut, tmp_path: Path) -> None:
    lut = make_lut()
    lines = [
        f"raw/s{scene}.cr2,{','.join(map(str, lut.white[light]))}" for scene, light in ((7, 0), (8, 2), (7, 1), (8, 3))
    ]
    path = written(tmp_path / "own.csv", "\n".join(["name,GT_R,GT_G,GT_B", *lines]))
    choice = named_lights(Gamut.of(lut), load_named_truths(path), ["s8.png", "s7.png"])
    assert [[lighting.mixtures[0].label for lighting in choice.lightings_of(at)] for at in (0, 1)] == [
        ["2", "3"],
        ["0", "1"],
    ]
    # Two pictures of one name in two folders do not share a light by chance.
    with pytest.raises(InputError, match="2 of 2 pictures"):
        named_lights(Gamut.of(lut), load_named_truths(path), ["one/s8.png", "other/s8.png"])


def test_what_is_refused(make_lut: MakeLut, tmp_path: Path) -> None:
    lut = make_lut()
    gamut = Gamut.of(lut)
    some = {"a.png": lut.white[:1], "b.png": lut.white[:2], "far.png": np.array([[1.0, 0.0, 0.0]])}
    cases = ((["a.png", "z.png"], "z.png"), (["a.png", "b.png"], "a.png has 1"), (["far.png"], r"far\.png"))
    for names, message in cases:
        with pytest.raises(InputError, match=message):
            named_lights(gamut, some, names)
    assert named_lights(gamut, some, ["far.png"], outside="nearest").matches[0][0].angle > 1
    for text in (
        "",
        "r,g,b\n1,1,1\n",
        "name,r,g,b\n",
        "name,r,g,b\na,1,x,1\n",
        "name,r,g,b\na,0,0,0\n",
        "name,r,g,b\n,1,1,1\n",
    ):
        with pytest.raises(FormatError):
            load_named_truths(written(tmp_path / "bad.csv", text))
    with pytest.raises(CropError):
        load_named_truths(tmp_path / "none.csv")
    with pytest.raises(InputError, match="both given"):
        LightOptions(lights_by_name=tmp_path / "x.csv", random=1).choose(lut, 1)


@pytest.fixture
def truths(tmp_path: Path, make_lut: MakeLut) -> Path:
    """Return a file of the ground truths of lights 2, 0 and 1 of the table."""
    path = tmp_path / "gt.txt"
    path.write_text("".join(f"{r} {g} {b}\n" for r, g, b in make_lut(name="other").white[[2, 0, 1]]))
    return path


def test_ground_truths_of_a_file(make_lut: MakeLut, truths: Path) -> None:
    lut = make_lut()
    for request in (LightOptions(nearest=truths), LightOptions(match=truths)):
        choice = request.choose(lut, 3)
        assert isinstance(choice, SequentialLights)
        assert [choice.lightings_of(at)[0].mixtures[0] for at in range(4)] == [plain(2), plain(0), plain(1), plain(2)]
    both = LightOptions(match=truths, lights_per_image=2, masks="window").choose(lut, 3)
    assert both.lights_each == 1
    assert [both.lightings_of(at)[0].mixtures for at in range(2)] == [(plain(2), plain(0)), (plain(1), plain(2))]
