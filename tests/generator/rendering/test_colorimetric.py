"""Rendering by colour: the camera records the colours of the picture, reproducibly."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from foundation.colorimetry import angles_deg
from foundation.errors import InputError, QualityError
from generator.dataset.plan import DatasetOptions
from generator.dataset.shards import photograph
from generator.kernels.printing import NODES, SIDE
from generator.lights.lighting import Lighting, Mixture, single_mixture
from generator.rendering.black_points import BlackPoint
from generator.rendering.colorimetric import (
    BLACK_WITHIN_DEG,
    ColorimetricRendering,
    _filled,
    black_point,
    compute_map,
    reference_light,
    source_colours,
)
from generator.rendering.matrices import ColourMatrix, camera_matrix, cameras, fitted_matrix, matrix_for
from generator.rendering.print_inverse import corners, invert
from generator.rendering.print_profiles import PrintProfile, neutral_ends, odd_cells, profile_of
from tests.generator.dataset.known import table_in
from tests.generator.rendering.conftest import MakeTable
from tests.generator.rendering.prints import MATRIX, printed
from tests.generator.said import said
from tests.pinned import Pinned

pytestmark = pytest.mark.slow


CAMERA = ColourMatrix("mine", MATRIX, "")

GREYS = np.arange(SIDE) * (SIDE * SIDE + SIDE + 1)  # Nodes of equal codes of red, green and blue

# All greys, (256, 1024, 3)
RAMP = np.repeat(np.arange(256, dtype=np.uint8)[:, None, None], 3, axis=2).repeat(1024, axis=1)


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "croplab"


@pytest.mark.parametrize("bits", [2, 4])
def test_greys_are_neutral_smooth_and_as_noisy_as_the_table(make_table: MakeTable, bits: int) -> None:
    lut = make_table(bits=bits, tint=0.15)
    grey_means = lut.samples[1][np.arange(1 << bits) * (1 + (1 << bits) + (1 << 2 * bits))].mean(axis=1)
    assert angles_deg(grey_means, lut.white[1]).max() > 4
    options = DatasetOptions(rendering="colorimetric", matrix=CAMERA)
    for light in (single_mixture(0), single_mixture(1), Mixture((0, 2), (0.3, 0.7))):
        image = photograph(lut, RAMP, Lighting((light,)), options, 3, 4, 11536).counts.astype(np.float64)
        means, spreads = image.mean(axis=1), image.std(axis=1)
        assert angles_deg(means, light.white(lut))[20:].max() < 0.4
        # The LUT has photon noise: the variance equals the mean.
        ratio = spreads[20:231] / np.sqrt(means[20:231])
        # The noise of a chart of 64 colours has an error of some percent.
        assert ratio.mean() == pytest.approx(1, abs=0.02 if bits > 2 else 0.04)
        assert np.abs(ratio - 1).max() < (0.12 if bits > 2 else 0.2)
        errors = spreads / np.sqrt(image.shape[1])
        rises = np.diff(means, axis=0)
        assert (rises / np.hypot(errors[1:], errors[:-1])).min() > -4
        # Smooth rise: consecutive codes add nearly equal amounts.
        brightness = means.sum(axis=1)
        error = np.sqrt((errors**2).sum(axis=1))[64:-2] * np.sqrt(6)
        bends = np.abs(np.diff(brightness, 2)[64:] / error)
        assert (bends > 3).mean() < 0.02
        assert bends.max() < 5


def test_reproduces_colours_inside_the_gamut(make_table: MakeTable) -> None:
    lut = make_table(bits=4)
    rendering = ColorimetricRendering(lut, CAMERA)
    nodes = rendering.node_means(single_mixture(1)) / lut.white[1]
    inside = ~rendering.map.outside
    # This print reproduces its codes, so all but the outermost colours are reached, except for noise.
    assert inside.mean() > 0.8
    expected = source_colours(CAMERA)
    relative = (nodes - nodes[0].mean()) / (nodes[-1].mean() - nodes[0].mean())
    assert np.abs(relative - expected)[inside].max() < 0.03
    assert rendering.map.distance[inside].mean() < 0.2
    assert rendering.black(single_mixture(1)) == pytest.approx(profile_of(lut, 1).black, rel=0.1)


@pytest.mark.parametrize(("blue_paper", "white"), [(0.85, 0.99 * 0.85), (0.9, 0.97 * 0.9)])
def test_black_and_white_are_greys_of_mixtures(blue_paper: float, white: float) -> None:
    colours = np.stack(np.meshgrid([0.1, 0.9], [0.1, 0.9], [0.2, blue_paper], indexing="ij"), axis=-1).reshape(8, 3)
    profile = PrintProfile(colours, np.ones(8, bool))
    assert (profile.bits, profile.black, profile.white) == (1, pytest.approx(0.2), pytest.approx(white))


def test_black_is_the_darkest_neutral_grey(make_table: MakeTable) -> None:
    def redden(samples: npt.NDArray[np.uint16]) -> None:
        samples[:] = np.rint(samples * [1.1, 1.0, 0.9])

    tinted = make_table(bits=4, change=redden)
    profile = profile_of(tinted, 1)
    darker = profile.colours[profile.colours.mean(axis=1) < profile.black]
    assert angles_deg(darker, np.ones(3)).min() > BLACK_WITHIN_DEG
    rendering = ColorimetricRendering(tinted, CAMERA)
    assert rendering.map.distance[0] <= BLACK_WITHIN_DEG
    assert rendering.black(single_mixture(1)) == pytest.approx(profile.black, rel=0.26)


def test_map_is_cached_by_table_and_matrix(make_table: MakeTable, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = ColorimetricRendering(make_table(bits=1), CAMERA).map
    (path,) = cache.iterdir()
    content = path.read_bytes()
    # A copy of a LUT has the same map; another matrix or LUT has not.
    again = ColorimetricRendering(make_table(bits=1, name="copy"), CAMERA)
    assert again.map.sha256 == first.sha256
    assert [file.name for file in cache.iterdir()] == [path.name]
    assert path.read_bytes() == content
    ColorimetricRendering(make_table(bits=1, name="third"), ColourMatrix("none", np.eye(3), "")).map  # noqa: B018
    ColorimetricRendering(make_table(bits=1, tint=0.1, name="fourth"), CAMERA).map  # noqa: B018
    assert len(list(cache.iterdir())) == 3
    # Maps of another numpy version are not used.
    monkeypatch.setattr("generator.rendering.colorimetric.version", "{} 0".format)
    ColorimetricRendering(make_table(bits=1, name="fifth"), CAMERA).map  # noqa: B018
    assert len(list(cache.iterdir())) == 4


def test_map_is_independent_of_rounding(make_table: MakeTable, monkeypatch: pytest.MonkeyPatch) -> None:
    lut = make_table(bits=3)
    sha256 = compute_map(lut, CAMERA).sha256

    def elsewhere(
        colours: npt.NDArray[np.float64], expected: npt.NDArray[np.float64], bits: int
    ) -> npt.NDArray[np.float64]:
        return invert(colours, expected, bits) + 1e-11 * np.sin(np.arange(3))

    monkeypatch.setattr("generator.rendering.colorimetric.invert", elsewhere)
    assert compute_map(lut, CAMERA).sha256 == sha256


def test_recomputes_damaged_map(make_table: MakeTable, cache: Path) -> None:
    lut = make_table(bits=1)
    whole = ColorimetricRendering(lut, CAMERA).map.sha256
    (path,) = cache.iterdir()
    for length in (-9, 0):
        path.write_bytes(path.read_bytes()[:length])
        assert ColorimetricRendering(lut, CAMERA).map.sha256 == whole, length


def test_works_without_writable_cache(make_table: MakeTable, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    rendering = ColorimetricRendering(make_table(bits=1), CAMERA, tmp_path / "file" / "folder")
    assert len(rendering.map.nearest) == NODES


def test_light_is_additive_except_for_neutral_greys(make_table: MakeTable) -> None:
    lut = make_table(bits=3)
    rendering = ColorimetricRendering(lut, CAMERA)
    mixed = rendering.node_means(Mixture((0, 2), (0.25, 0.75)))
    sums = 0.25 * rendering.node_means(single_mixture(0)) + 0.75 * rendering.node_means(single_mixture(2))
    np.testing.assert_allclose(mixed, sums, rtol=0.02, atol=2)
    assert angles_deg(mixed[GREYS], Mixture((0, 2), (0.25, 0.75)).white(lut)).max() < 1e-4
    with pytest.raises(InputError, match="no illuminant 9"):
        rendering.node_means(single_mixture(9))


def test_black_subtraction_keeps_means_and_white(make_table: MakeTable) -> None:
    lut = make_table(bits=3)
    options = DatasetOptions(rendering="colorimetric", matrix=CAMERA, black_point=BlackPoint("compensate"))
    whole = photograph(
        lut, RAMP, Lighting((single_mixture(1),)), replace(options, black_point=BlackPoint()), 3, 4, 11536
    ).counts
    subtracted = photograph(lut, RAMP, Lighting((single_mixture(1),)), options, 3, 4, 11536).counts
    black, white = whole[0].mean(axis=0), lut.white[1]
    expected = (whole.mean(axis=1) - black) / (1 - black / white)
    # Clipped at 0, noise would raise black by 0.4 σ, 6 counts here.
    np.testing.assert_allclose(subtracted.mean(axis=1), expected, atol=2.5)
    assert subtracted.mean(axis=1)[0].max() < 1


def test_reference_light_has_all_channels() -> None:
    def table(*lights: tuple[float, float]) -> Any:
        bodies = [SimpleNamespace(index=place, cct_k=kelvin) for place, (kelvin, _) in enumerate(lights)]
        return SimpleNamespace(white=np.array([[900, 1000, 1000 * blue] for _, blue in lights]), illuminations=bodies)

    assert reference_light(table((4900, 0.5), (6500, 0.5))) == 1
    assert reference_light(table((5600, 0.19), (3000, 0.2), (2000, 0.3))) == 1
    assert reference_light(table((3000, 0.1), (5600, 0.19))) == 1


def test_table_of_one_light(make_table: MakeTable) -> None:
    rendering = ColorimetricRendering(make_table(bits=1, lights=1), CAMERA)
    assert rendering.cells.max() < 8
    assert np.isfinite(rendering.node_means(single_mixture(0))).all()


def test_fitted_matrix_reports_residual_of_tinted_print(make_table: MakeTable) -> None:
    fitted = fitted_matrix(make_table(bits=4, tint=0.3))
    assert "median residual" in fitted.source
    assert float(fitted.source.split()[-2]) > 1


def test_excludes_clipped_and_hot_patches(make_table: MakeTable) -> None:
    def spoil(samples: npt.NDArray[np.uint16]) -> None:
        samples[100, 3, 0] = 9000
        samples[511] = np.minimum(samples[511], 5000)

    lut = make_table(change=spoil, white_level=11000)
    assert np.flatnonzero(~profile_of(lut, 1).usable).tolist() == [100]
    # If the paper is above saturation, the white point follows the brightest patches below it.
    clipped = make_table(white_level=5000, name="clipped")
    profile = profile_of(clipped, 1)
    assert not profile.usable[511]
    assert profile.usable.sum() > 300
    whole = profile_of(make_table(name="whole"), 1)
    assert profile.white < whole.white
    greys = ColorimetricRendering(clipped, CAMERA).node_means(single_mixture(1))[GREYS]
    assert angles_deg(greys, clipped.white[1]).max() < 0.1
    assert greys.max() < 5000


@pytest.mark.parametrize("lights", [{0, 1, 2}, {0}], ids=["in every light", "in the warmest, which has little blue"])
def test_unusable_patches_do_not_influence_nodes(make_table: MakeTable, lights: set[int]) -> None:
    number = itertools.count()

    def spoil(samples: npt.NDArray[np.uint16]) -> None:
        if next(number) in lights:
            samples[146, 3] = 9000

    spoilt, whole = make_table(change=spoil), make_table(name="whole")
    rendering = ColorimetricRendering(spoilt, CAMERA)
    nodes, chart = rendering.node_means(single_mixture(1)), rendering.map
    assert 146 in ColorimetricRendering(whole, CAMERA).cells
    assert 146 not in rendering.cells
    assert not chart.weights[chart.cells[chart.around] == 146].any()
    np.testing.assert_allclose(nodes, ColorimetricRendering(whole, CAMERA).node_means(single_mixture(1)), rtol=0.25)


def test_refuses_spoilt_black(make_table: MakeTable) -> None:
    def spoil(samples: npt.NDArray[np.uint16]) -> None:
        samples[0] = (samples[511] * 0.7).astype(np.uint16)

    with pytest.raises(QualityError, match=r"illuminant 1 .*black.*0\.6\d* × white"):
        ColorimetricRendering(make_table(change=spoil), CAMERA).node_means(single_mixture(1))


OWN_MATRIX = ColourMatrix("mine", MATRIX, "a test")


def test_matrices(make_table: MakeTable, tmp_path: Path, pinned: Pinned, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    pins: dict[str, Any] = {name: camera_matrix(name) for name in cameras()}
    pins |= {name: camera_matrix(name) for name in ("550d", "Canon EOS-550D", "eos 5ds r", "", "canon", "60")}
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
    pins |= {f"asked for {name}": said(matrix_for, lut, name) for name in names}
    pinned("colour matrices", {**pins, "fitted": [fitted_matrix(lut), fitted_matrix(other)]})


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
    map_of = compute_map(lut, OWN_MATRIX)
    rendering = ColorimetricRendering(lut, OWN_MATRIX, tmp_path / "kept")
    mixture = Mixture((0, 1), (0.3, 0.7))
    pins: list[Any] = [reference_light(lut)]
    pins += [[profile.colours, profile.usable, profile.bits, profile.black, profile.white] for profile in profiles]
    pins += [odd_cells(samples, samples.mean(axis=1)), vars(map_of), map_of.gamut_error(np.arange(4913))]
    # Colours of unusable patches may be 0, and a search needs colours above 0.
    filled = [_filled(profile.colours, profile.usable, profile.bits) for profile in profiles]
    pins.append(
        [black_point(profile, colours, profile.bits) for profile, colours in zip(profiles, filled, strict=True)]
    )
    targets = 0.2 + 0.5 * source_colours(OWN_MATRIX)[::400]
    pins.append(invert(filled[-1], targets, profiles[-1].bits))
    for light in (*map(single_mixture, lights), mixture):
        for share in (0.0, 0.7):
            outcome = said(rendering.printed_light, light, share)
            pins.append(outcome if isinstance(outcome, dict) else [rendering.black(light), vars(outcome)])
    picture = np.random.default_rng(17).integers(0, 256, (21, 37, 3)).astype(np.uint8)
    ramp = np.stack([np.linspace(0, 1, 37)] * 21)
    weights = np.stack([ramp, 1 - ramp], axis=-1).astype(np.float32)
    pins.append(said(rendering.draw, picture, [single_mixture(0), mixture], 0.4, weights))
    # Positions depend on where a descent ends.
    pinned(f"map of a print, {case}", pins, same=1e-5, nothing=1e-7)


def test_positions_in_a_print(pinned: Pinned) -> None:
    rng = np.random.default_rng(18)
    pins: list[Any] = [source_colours(OWN_MATRIX)]
    for bits in (1, 2, 4):
        top = 2**bits - 1
        positions = np.concatenate([rng.uniform(-0.2, top + 0.2, (6, 3)), [[0, 0, 0], [top] * 3, [0, top, 0.5]]])
        pins.append(corners(positions, bits))
        colours = printed(bits, tint=0.1)
        expected = rng.uniform(0.05, 0.9, (12, 3)) ** 2
        pins.append(invert(colours, expected, bits))
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
    pins.append([neutral_ends(points) for points in clouds])
    pinned("places in a print", pins, same=1e-5, nothing=1e-7)
