"""Rendering by colour: what the camera sees of a print is the picture's colours, and the same for a seed."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.interpolate import RegularGridInterpolator

from foundation.colorimetry import angles_deg
from foundation.errors import InputError, QualityError
from generator.dataset.plan import DatasetOptions
from generator.dataset.shards import photograph
from generator.kernels.printing import NODES, SIDE
from generator.lights.lighting import Lighting, Mixture, single_mixture
from generator.rendering import print_inverse
from generator.rendering.black_points import BlackPoint
from generator.rendering.colorimetric import (
    BLACK_WITHIN_DEG,
    ColorimetricRendering,
    black_point,
    find_map,
    reference_light,
    source_colours,
)
from generator.rendering.matrices import ColourMatrix, camera_matrix, cameras, fitted_matrix, matrix_for
from generator.rendering.print_inverse import corners, invert, nearest_to
from generator.rendering.print_profiles import PrintProfile, neutral_ends, odd_cells, profile_of
from tests.generator.dataset.known import table_in
from tests.generator.rendering.conftest import MakeTable
from tests.generator.rendering.prints import MATRIX, printed
from tests.generator.said import said
from tests.pinned import Pinned

pytestmark = pytest.mark.slow


MINE = ColourMatrix("mine", MATRIX, "")

GREYS = np.arange(SIDE) * (SIDE * SIDE + SIDE + 1)
"""Nodes of equal codes of red, green and blue."""

RAMP = np.repeat(np.arange(256, dtype=np.uint8)[:, None, None], 3, axis=2).repeat(1024, axis=1)
"""All greys, (256, 1024, 3)."""


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "croplab"


@pytest.mark.parametrize("bits", [2, 4])
def test_greys_are_of_the_light_with_the_noise_of_the_table_and_no_step(make_table: MakeTable, bits: int) -> None:
    lut = make_table(bits=bits, tint=0.15)
    own = lut.samples[1][np.arange(1 << bits) * (1 + (1 << bits) + (1 << 2 * bits))].mean(axis=1)
    assert angles_deg(own, lut.white[1]).max() > 4
    options = DatasetOptions(rendering="colorimetric", matrix=MINE)
    for light in (single_mixture(0), single_mixture(1), Mixture((0, 2), (0.3, 0.7))):
        image = photograph(lut, RAMP, Lighting((light,)), options, 3, 4, 11536).counts.astype(np.float64)
        means, spreads = image.mean(axis=1), image.std(axis=1)
        assert angles_deg(means, light.white(lut))[20:].max() < 0.4
        # The table's noise is that of photons: a variance of a count for each count.
        ratio = spreads[20:231] / np.sqrt(means[20:231])
        # A chart of 64 colours knows its noise to some percent.
        assert ratio.mean() == pytest.approx(1, abs=0.02 if bits > 2 else 0.04)
        assert np.abs(ratio - 1).max() < (0.12 if bits > 2 else 0.2)
        errors = spreads / np.sqrt(image.shape[1])
        rises = np.diff(means, axis=0)
        assert (rises / np.hypot(errors[1:], errors[:-1])).min() > -4
        # Even rises: what one code adds is nearly what the next one does.
        brightness = means.sum(axis=1)
        error = np.sqrt((errors**2).sum(axis=1))[64:-2] * np.sqrt(6)
        bends = np.abs(np.diff(brightness, 2)[64:] / error)
        assert (bends > 3).mean() < 0.02
        assert bends.max() < 5


def test_a_print_of_known_colours_is_met_where_it_can_be(make_table: MakeTable) -> None:
    lut = make_table(bits=4)
    rendering = ColorimetricRendering(lut, MINE)
    seen = rendering.seen(single_mixture(1)) / lut.white[1]
    inside = ~rendering.map.outside
    # This print shows just what its codes say, so that all but its noise and the outermost colours are met.
    assert inside.mean() > 0.8
    wanted = source_colours(MINE)
    shown = (seen - seen[0].mean()) / (seen[-1].mean() - seen[0].mean())
    assert np.abs(shown - wanted)[inside].max() < 0.03
    assert rendering.map.distance[inside].mean() < 0.2
    assert rendering.black(single_mixture(1)) == pytest.approx(profile_of(lut, 1).black, rel=0.1)


@pytest.mark.parametrize(("blue_paper", "white"), [(0.85, 0.99 * 0.85), (0.9, 0.97 * 0.9)])
def test_black_and_white_are_greys_that_mixtures_make(blue_paper: float, white: float) -> None:
    """A box of colours, paper last: its greys end at the blue of its black, and short of its paper's blue."""
    colours = np.stack(np.meshgrid([0.1, 0.9], [0.1, 0.9], [0.2, blue_paper], indexing="ij"), axis=-1).reshape(8, 3)
    profile = PrintProfile(colours, np.ones(8, bool))
    assert (profile.bits, profile.black, profile.white) == (1, pytest.approx(0.2), pytest.approx(white))


def test_places_are_the_inverse_of_what_is_seen() -> None:
    bits = 3
    codes = np.stack([np.arange(512) >> 6, np.arange(512) >> 3 & 7, np.arange(512) & 7], axis=-1) / 7
    colours = (0.05 + 0.9 * codes**2.2) @ np.array([[0.8, 0.1, 0.1], [0.2, 0.7, 0.1], [0.0, 0.2, 0.8]])
    places = np.random.default_rng(4).uniform(0, 7, (200, 3))
    around, weights = corners(places, bits)
    wanted = np.einsum("kc,kcx->kx", weights, colours[around])
    found = nearest_to(colours, wanted, np.clip(places + 0.7, 0, 7), bits)
    np.testing.assert_allclose(found, places, atol=1e-3)
    # What is out of reach ends on the surface, nearer than any cell.
    beyond = wanted * [1.6, 0.7, 0.7]
    found = nearest_to(colours, beyond, places, bits)
    around, weights = corners(found, bits)
    missed = angles_deg(np.einsum("kc,kcx->kx", weights, colours[around]), beyond)
    assert np.median(missed) < 0.1 or ((found <= 0) | (found >= 7)).any(axis=1).mean() > 0.5


def test_black_is_as_dark_as_it_can_be_grey(make_table: MakeTable) -> None:
    def redden(samples: npt.NDArray[np.uint16]) -> None:
        samples[:] = np.rint(samples * [1.1, 1.0, 0.9])

    tinted = make_table(bits=4, change=redden)
    profile = profile_of(tinted, 1)
    darker = profile.colours[profile.colours.mean(axis=1) < profile.black]
    assert angles_deg(darker, np.ones(3)).min() > BLACK_WITHIN_DEG
    rendering = ColorimetricRendering(tinted, MINE)
    assert rendering.map.distance[0] <= BLACK_WITHIN_DEG
    assert rendering.black(single_mixture(1)) == pytest.approx(profile.black, rel=0.26)


def test_a_map_is_found_once_for_a_table_and_a_matrix(
    make_table: MakeTable, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = ColorimetricRendering(make_table(bits=1), MINE).map
    (path,) = cache.iterdir()
    content = path.read_bytes()
    # The same table at another place is the same table; another matrix or table is not.
    again = ColorimetricRendering(make_table(bits=1, name="copy"), MINE)
    assert again.map.sha256 == first.sha256
    assert [file.name for file in cache.iterdir()] == [path.name]
    assert path.read_bytes() == content
    ColorimetricRendering(make_table(bits=1, name="third"), ColourMatrix("none", np.eye(3), "")).map  # noqa: B018
    ColorimetricRendering(make_table(bits=1, tint=0.1, name="fourth"), MINE).map  # noqa: B018
    assert len(list(cache.iterdir())) == 3
    # Nor is what another numpy has computed.
    monkeypatch.setattr("generator.rendering.colorimetric.version", "{} 0".format)
    ColorimetricRendering(make_table(bits=1, name="fifth"), MINE).map  # noqa: B018
    assert len(list(cache.iterdir())) == 4


def test_a_map_does_not_depend_on_last_digits(make_table: MakeTable, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those that processors and libraries differ in: pixels are the same on every machine."""
    lut = make_table(bits=3)
    before = find_map(lut, MINE).sha256

    def elsewhere(
        colours: npt.NDArray[np.float64], greys: npt.NDArray[np.float64], wanted: npt.NDArray[np.float64], bits: int
    ) -> npt.NDArray[np.float64]:
        return invert(colours, greys, wanted, bits) + 1e-11 * np.sin(np.arange(3))

    monkeypatch.setattr("generator.rendering.colorimetric.invert", elsewhere)
    assert find_map(lut, MINE).sha256 == before


def test_a_damaged_map_is_as_good_as_none(make_table: MakeTable, cache: Path) -> None:
    lut = make_table(bits=1)
    whole = ColorimetricRendering(lut, MINE).map.sha256
    (path,) = cache.iterdir()
    for length in (-9, 0):
        path.write_bytes(path.read_bytes()[:length])
        assert ColorimetricRendering(lut, MINE).map.sha256 == whole, length


def test_where_nothing_can_be_kept_nothing_is(make_table: MakeTable, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    rendering = ColorimetricRendering(make_table(bits=1), MINE, tmp_path / "file" / "folder")
    assert len(rendering.map.nearest) == NODES


def test_light_adds_but_for_the_tint_of_greys(make_table: MakeTable) -> None:
    lut = make_table(bits=3)
    rendering = ColorimetricRendering(lut, MINE)
    mixed = rendering.seen(Mixture((0, 2), (0.25, 0.75)))
    sums = 0.25 * rendering.seen(single_mixture(0)) + 0.75 * rendering.seen(single_mixture(2))
    np.testing.assert_allclose(mixed, sums, rtol=0.02, atol=2)
    assert angles_deg(mixed[GREYS], Mixture((0, 2), (0.25, 0.75)).white(lut)).max() < 1e-4
    with pytest.raises(InputError, match="no illuminant 9"):
        rendering.seen(single_mixture(9))


def test_black_that_is_taken_out_leaves_means_and_white(make_table: MakeTable) -> None:
    lut = make_table(bits=3)
    options = DatasetOptions(rendering="colorimetric", matrix=MINE, black_point=BlackPoint("compensate"))
    kept = photograph(
        lut, RAMP, Lighting((single_mixture(1),)), replace(options, black_point=BlackPoint()), 3, 4, 11536
    ).counts
    bare = photograph(lut, RAMP, Lighting((single_mixture(1),)), options, 3, 4, 11536).counts
    black, white = kept[0].mean(axis=0), lut.white[1]
    wanted = (kept.mean(axis=1) - black) / (1 - black / white)
    # Cut off at 0, noise would lift black by .4 of it, 6 counts here.
    np.testing.assert_allclose(bare.mean(axis=1), wanted, atol=2.5)
    assert bare.mean(axis=1)[0].max() < 1


def test_the_reference_is_near_in_reciprocal_kelvin_and_sees_every_channel() -> None:
    def table(*lights: tuple[float, float]) -> Any:
        """Return what is asked of a table of black bodies, each of so many kelvin and such a share of blue."""
        bodies = [SimpleNamespace(index=place, cct_k=kelvin) for place, (kelvin, _) in enumerate(lights)]
        return SimpleNamespace(white=np.array([[900, 1000, 1000 * blue] for _, blue in lights]), illuminations=bodies)

    assert reference_light(table((4900, 0.5), (6500, 0.5))) == 1
    assert reference_light(table((5600, 0.19), (3000, 0.2), (2000, 0.3))) == 1
    assert reference_light(table((3000, 0.1), (5600, 0.19))) == 1


def test_a_table_of_one_light(make_table: MakeTable) -> None:
    rendering = ColorimetricRendering(make_table(bits=1, lights=1), MINE)
    assert rendering.cells.max() < 8
    assert np.isfinite(rendering.seen(single_mixture(0))).all()


def test_a_print_that_is_off_makes_a_fitted_matrix_say_so(make_table: MakeTable) -> None:
    fitted = fitted_matrix(make_table(bits=4, tint=0.3))
    assert "degrees off in the median" in fitted.source
    assert float(fitted.source.split("; ")[1].split()[0]) > 1


def test_cells_that_clip_and_cells_with_hot_samples_are_not_used(make_table: MakeTable) -> None:
    def spoil(samples: npt.NDArray[np.uint16]) -> None:
        samples[100, 3, 0] = 9000
        samples[511] = np.minimum(samples[511], 5000)

    lut = make_table(change=spoil, white_level=11000)
    assert np.flatnonzero(~profile_of(lut, 1).usable).tolist() == [100]
    # The paper clips when saturation is below it, and the white point follows what does not.
    clipped = make_table(white_level=5000, name="clipped")
    profile = profile_of(clipped, 1)
    assert not profile.usable[511]
    assert profile.usable.sum() > 300
    whole = profile_of(make_table(name="whole"), 1)
    assert profile.white < whole.white
    shown = ColorimetricRendering(clipped, MINE).seen(single_mixture(1))[GREYS]
    assert angles_deg(shown, clipped.white[1]).max() < 0.1
    assert shown.max() < 5000


@pytest.mark.parametrize("lights", [{0, 1, 2}, {0}], ids=["in every light", "in the warmest, which has little blue"])
def test_cells_that_are_not_usable_are_not_seen(make_table: MakeTable, lights: set[int]) -> None:
    """An odd cell under any light that is dark in a channel, and its neighbours do without it."""
    number = itertools.count()

    def spoil(samples: npt.NDArray[np.uint16]) -> None:
        if next(number) in lights:
            samples[146, 3] = 9000

    spoilt, whole = make_table(change=spoil), make_table(name="whole")
    rendering = ColorimetricRendering(spoilt, MINE)
    seen, found = rendering.seen(single_mixture(1)), rendering.map
    assert 146 in ColorimetricRendering(whole, MINE).cells
    assert 146 not in rendering.cells
    assert not found.weights[found.cells[found.around] == 146].any()
    np.testing.assert_allclose(seen, ColorimetricRendering(whole, MINE).seen(single_mixture(1)), rtol=0.25)


def test_a_black_that_is_spoilt_is_named_and_makes_no_flat_image(make_table: MakeTable) -> None:
    def spoil(samples: npt.NDArray[np.uint16]) -> None:
        samples[0] = (samples[511] * 0.7).astype(np.uint16)

    with pytest.raises(QualityError, match=r"light 1 .*black.*0\.6\d* of white"):
        ColorimetricRendering(make_table(change=spoil), MINE).seen(single_mixture(1))


def test_what_is_missed_and_its_slopes_are_those_of_the_print_between_its_cells() -> None:
    side, rng = 4, np.random.default_rng(8)
    colours, target = rng.uniform(0.1, 1, (side**3, 3)), np.log([0.3, 0.5, 0.4])
    cells = colours.reshape(side, side, side, 3)
    print_at = RegularGridInterpolator([np.arange(side)] * 3, cells, bounds_error=False, fill_value=None)
    # Brightness counts half of what chromaticity does; each is seen along axes of length 1.
    scale = np.array([[0.5**0.5 / 3**0.5] * 3, [0.5**0.5, 0, -(0.5**0.5)], [6**-0.5, -2 * 6**-0.5, 6**-0.5]])
    np.testing.assert_allclose(print_inverse._SCALE, scale)

    def missed(place: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        return scale @ (np.log(print_at(place)[0]) - target)

    for place in [*rng.uniform(0.1, 2.9, (9, 3)), np.zeros(3), np.full(3, 3.0)]:
        miss, slopes = np.empty(3), np.empty((3, 3))
        square = print_inverse._look(colours, place, target, side, scale, miss, slopes)
        np.testing.assert_allclose(miss, missed(place))
        assert square == pytest.approx((miss**2).sum())
        steps = 1e-5 * np.eye(3)
        expected = [(missed(place + step) - missed(place - step)) / 2e-5 for step in steps]
        np.testing.assert_allclose(slopes, np.transpose(expected), atol=1e-6)


OWN_MATRIX = ColourMatrix("mine", MATRIX, "a test")


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
    map_of = find_map(lut, OWN_MATRIX)
    rendering = ColorimetricRendering(lut, OWN_MATRIX, tmp_path / "kept")
    mixture = Mixture((0, 1), (0.3, 0.7))
    found: list[Any] = [reference_light(lut)]
    found += [[one.colours, one.usable, one.bits, one.black, one.white] for one in profiles]
    found += [odd_cells(samples, samples.mean(axis=1)), vars(map_of), map_of.missed(np.arange(4913))]
    colours = profiles[-1].colours
    found.append([black_point(one, one.colours, one.bits) for one in profiles])
    found.append(
        nearest_to(colours, 0.2 + 0.5 * source_colours(OWN_MATRIX)[::400], np.full((13, 3), 0.5), profiles[-1].bits)
    )
    for light in (*map(single_mixture, lights), mixture):
        for share in (0.0, 0.7):
            made = said(rendering.printed, light, share)
            found.append(made if isinstance(made, dict) else [rendering.black(light), vars(made)])
    picture = np.random.default_rng(17).integers(0, 256, (21, 37, 3)).astype(np.uint8)
    ramp = np.stack([np.linspace(0, 1, 37)] * 21)
    weights = np.stack([ramp, 1 - ramp], axis=-1).astype(np.float32)
    found.append(said(rendering.draw, picture, [single_mixture(0), mixture], 0.4, weights))
    # Places are those at which a descent ends.
    pinned(f"map of a print, {case}", found, same=1e-5, nothing=1e-7)


def test_places_in_a_print(pinned: Pinned) -> None:
    rng = np.random.default_rng(18)
    found: list[Any] = [source_colours(OWN_MATRIX)]
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
