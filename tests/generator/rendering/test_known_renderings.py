"""Matrices, profiles, maps and black points of known prints, as they were found before."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from generator.lights.lighting import Mixture, plain
from generator.rendering.black_points import BlackPoint, black_of, parse_black_point, veil_of, without_veil
from generator.rendering.colorimetric import (
    ColorimetricRendering,
    black_point,
    find_map,
    reference_light,
    source_colours,
)
from generator.rendering.matrices import ColourMatrix, camera_matrix, cameras, fitted_matrix, matrix_for
from generator.rendering.print_inverse import corners, invert, nearest_to
from generator.rendering.print_profiles import neutral_ends, odd_cells, profile_of
from tests.generator.dataset.known import table_in
from tests.generator.rendering.conftest import MakeTable
from tests.generator.rendering.prints import MATRIX, printed
from tests.generator.said import said
from tests.pinned import Pinned

pytestmark = pytest.mark.slow

MINE = ColourMatrix("mine", MATRIX, "a test")


def test_matrices(make_table: MakeTable, tmp_path: Path, pinned: Pinned, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    found: dict[str, Any] = {name: camera_matrix(name) for name in cameras()}
    found |= {name: camera_matrix(name) for name in ("550d", "Canon EOS-550D", "eos 5ds r", "", "canon", "60")}
    texts = {
        "plain": "1 0 0\n0 1 0\n0 0 1\n",
        "remarks": "# a\n2,1;1 # b\n\n0 3 1\n1e6 -9e5 1\n",
        "few": "1 2 3\n4 5 6\n",
    }
    texts |= {"large": "1e6 0 0\n0 1e6 0\n0 0 1.1e6\n", "zero": "1 0 -1\n0 1 0\n0 0 1\n", "words": "a b c\n"}
    for name, text in texts.items():
        Path(name).write_text(text, "utf-8")
    lut, other = make_table(name="lut"), table_in(Path("other"))
    names = (*texts, None, " Table", "none", "NONE ", "1000d", "absent")
    found |= {f"asked for {name}": said(matrix_for, lut, name) for name in names}
    pinned("colour matrices", {**found, "fitted": [fitted_matrix(lut), fitted_matrix(other)]})


@pytest.mark.parametrize("case", ["plain", "odd", "small"])
def test_maps_of_prints(case: str, make_table: MakeTable, tmp_path: Path, pinned: Pinned) -> None:
    def spoil(samples: Any) -> None:
        samples[37, 3], samples[100] = 11000, 0
        samples[5, :, 1] = 11536

    changes: dict[str, dict[str, Any]] = {
        "plain": {},
        "odd": {"change": spoil, "lights": 2},
    }
    lut = make_table(**changes[case]) if case in changes else table_in(tmp_path / "known")
    lights = range(len(lut.white))
    profiles = [profile_of(lut, light) for light in lights]
    samples = np.asarray(lut.samples[0])
    map_of = find_map(lut, MINE)
    rendering = ColorimetricRendering(lut, MINE, tmp_path / "kept")
    mixture = Mixture((0, 1), (0.3, 0.7))
    found: list[Any] = [reference_light(lut)]
    found += [[one.colours, one.usable, one.bits, one.black, one.white] for one in profiles]
    found += [odd_cells(samples, samples.mean(axis=1)), vars(map_of), map_of.missed(np.arange(4913))]
    colours = profiles[-1].colours
    found.append([black_point(one, one.colours, one.bits) for one in profiles])
    found.append(nearest_to(colours, 0.2 + 0.5 * source_colours(MINE)[::400], np.full((13, 3), 0.5), profiles[-1].bits))
    for light in (*map(plain, lights), mixture):
        for share in (0.0, 0.7):
            made = said(rendering.printed, light, share)
            found.append(made if isinstance(made, dict) else [rendering.black(light), vars(made)])
    picture = np.random.default_rng(17).integers(0, 256, (21, 37, 3)).astype(np.uint8)
    ramp = np.stack([np.linspace(0, 1, 37)] * 21)
    weights = np.stack([ramp, 1 - ramp], axis=-1).astype(np.float32)
    found.append(said(rendering.draw, picture, [plain(0), mixture], 0.4, weights))
    # Places are those at which a descent ends.
    pinned(f"map of a print, {case}", found, same=1e-5, nothing=1e-7)


def test_places_in_a_print(pinned: Pinned) -> None:
    rng = np.random.default_rng(18)
    found: list[Any] = [source_colours(MINE)]
    for bits in (1, 2, 4):
        top = 2**bits - 1
        places = np.concatenate([rng.uniform(-0.2, top + 0.2, (6, 3)), [[0, 0, 0], [top] * 3, [0, top, 0.5]]])
        found.append(corners(places, bits))
        colours = printed(bits, tint=0.1)
        wanted = rng.uniform(0.05, 0.9, (12, 3)) ** 2
        found.append([invert(colours, greys, wanted, bits) for greys in (wanted.mean(axis=1), wanted[:, 1])])
    cloud = rng.uniform(0, 1, (60, 3))
    clouds = (
        cloud,
        cloud[:3],
        cloud + np.array([0.5, 0, 0]),
        cloud * [1, 1, 0],
        0.5 + 0.1 * cloud,
        cloud - 0.5,
        cloud + np.array([2, 0, 0]),
    )
    found.append([neutral_ends(one) for one in clouds])
    pinned("places in a print", found, same=1e-5, nothing=1e-7)


def test_black_points(make_table: MakeTable, tmp_path: Path, pinned: Pinned) -> None:
    texts = ("keep", "compensate", "like", "random", "random:.8", "random:1", "random:0", "random:1.01", "random:", "x")
    points = {text: said(parse_black_point, text) for text in texts}
    words = np.array([0, 1, 2**31, 2**32 - 1], np.uint32)
    found: dict[str, Any] = {}
    for text, point in points.items():
        found[text] = point if isinstance(point, dict) else [
            point.label, said(point.shares, words), [said(point.share, 2**40 + 9, image) for image in (0, 1, 70000)]
        ]  # fmt: skip
    assert BlackPoint() == points["keep"]
    for name, lut in (("print", make_table()), ("known", table_in(tmp_path / "known"))):
        for light in (plain(0), plain(1), Mixture((0, 2), (0.4, 0.6))):
            samples = np.array(light.samples(lut))
            for share, grey in ((0.0, None), (0.5, None), (1.0, None), (0.9, 0.1), (1.0, 0.5)):
                veil = said(veil_of, lut, light, share, grey)
                label = f"{name} {light.label} {share} {grey}"
                if isinstance(veil, dict):
                    found[label] = veil
                    continue
                some = np.arange(len(samples)) % 3 == 0
                out = [without_veil(samples, veil, white, some) for white in (700, lut.provenance.white_level)]
                out.append(without_veil(samples, veil, 65535))
                found[label] = [black_of(lut, light), veil, b"".join(one.tobytes() for one in out)]
    pinned("black points", found)
