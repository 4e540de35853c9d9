"""The noise of a table, told from its samples."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from calibration.citation import OriginRecord
from calibration.table.lut import Lut
from foundation.errors import InputError
from generator.variation.iso_speed import IsoSpeed, known_of_table, parse_iso
from generator.variation.sensor_noise import SensorNoise, Three, measured_noise
from sim.world.sensors import BODIES
from tests.generator.conftest import MakeLut


def table(read: float, shot: float, response: float = 0.0, texture: float = 0.0, unfit: tuple[int, ...] = ()) -> Lut:
    """Return what `measured_noise` reads of a table of 512 colours under 8 lights, as a camera would have given it."""
    rng = np.random.default_rng(11)
    levels = np.geomspace(40, 6000, 512)
    means = np.linspace(0.3, 1, 8)[:, None] * levels
    noise = np.sqrt(read**2 + shot * means + (response * means) ** 2)[..., None, None]
    samples = means[..., None, None] + noise * rng.normal(size=(8, 512, 25, 3))
    samples += texture * rng.normal(size=(8, 512, 1, 1)) * rng.choice([-1, 1], (8, 512, 25, 1))
    samples[:, list(unfit)] = rng.uniform(0, 9000, (8, len(unfit), 25, 3))
    counts = np.rint(samples).clip(0).astype(np.uint16)
    return cast(
        "Lut",
        SimpleNamespace(
            folder=Path("lut"),
            samples=counts,
            light_samples=counts.__getitem__,
            white=means[:, -1:].repeat(3, axis=1),
            provenance=SimpleNamespace(
                computed=None, origin=None, unfit=[SimpleNamespace(colour=colour) for colour in unfit]
            ),
        ),
    )


@pytest.mark.parametrize("response", [0.0, 0.004])
def test_the_noise_is_found_again(response: float) -> None:
    noise = measured_noise(table(6.0, 0.55, response, unfit=(3, 400)))
    assert noise.read == pytest.approx([6.0] * 3, rel=0.05)
    assert noise.shot == pytest.approx([0.55] * 3, rel=0.04)


def test_samples_that_are_no_photograph_are_refused() -> None:
    # Cells of a coarse print: their variance has nothing to do with their level.
    lut = table(1.0, 0.1)
    rng = np.random.default_rng(2)
    wild = np.asarray(lut.samples).astype(np.float64) + rng.choice([0, 40], (8, 512, 1, 1)) * rng.normal(
        size=(8, 512, 25, 1)
    )
    counts = wild.clip(1, 65535).astype(np.uint16)
    vars(lut).update(samples=counts, light_samples=counts.__getitem__)
    with pytest.raises(InputError):
        measured_noise(lut)


def test_too_few_cells_are_refused(make_lut: MakeLut) -> None:
    with pytest.raises(InputError):
        measured_noise(make_lut(bits=1, lights=1))


def test_a_table_of_poisson_samples(make_lut: MakeLut) -> None:
    noise = measured_noise(make_lut(bits=3))
    assert noise.shot == pytest.approx([1.0] * 3, rel=0.1)


def test_speeds_are_any_numbers_above_0() -> None:
    assert IsoSpeed(0.5, 0.25, 0.0).ratio == 2
    for wrong in ((0.0, 100.0, 1.0), (100.0, 0.0, 1.0), (100.0, 100.0, -0.1), (100.0, 100.0, 1e6), (np.inf, 1.0, 1.0)):
        with pytest.raises(InputError):
            IsoSpeed(*wrong)
    with pytest.raises(InputError):
        IsoSpeed(199.9, 200)


def test_another_speed_of_the_simulated_bodies() -> None:
    # A body's facts say how much of its read noise arises before the amplifier; green is the mean of two photosites.
    for body in BODIES.values():
        at = SensorNoise(*_of_body(body, 100)).at(16, body.sensor_noise_e)
        read, shot = _of_body(body, 1600)
        assert at.read == pytest.approx(read, rel=1e-5)
        assert at.shot == pytest.approx(shot, rel=1e-5)


def _of_body(body: Any, iso: int) -> tuple[Three, Three]:
    read, gain = body.noise_dn(iso), body.gain_e(iso)
    return (read, read / 2**0.5, read), (1 / gain, 0.5 / gain, 1 / gain)


def test_read_noise_before_the_amplifier_is_no_more_than_all() -> None:
    assert SensorNoise((2.0, 2.0, 2.0), (1.0, 1.0, 1.0)).at(10, 100.0).read == pytest.approx([20.0] * 3)
    assert SensorNoise((2.0, 2.0, 2.0), (1.0, 1.0, 1.0)).at(10, 0.0).read == pytest.approx([2.0] * 3)


def test_a_photographed_table_says_its_speed() -> None:
    lut = table(6.0, 0.55)
    object.__setattr__(lut.provenance, "origin", OriginRecord(iso=400))
    assert known_of_table(lut) == (400.0, 2.5)
    assert parse_iso("1600", *known_of_table(lut)).ratio == 4
    with pytest.raises(InputError, match=r"ISO 100.*400"):
        parse_iso("1600/100", *known_of_table(lut))
    object.__setattr__(lut.provenance, "origin", OriginRecord())
    assert known_of_table(lut) == (None, 2.5)


def test_a_computed_table_says_its_speed() -> None:
    lut = table(6.0, 0.55)
    assert known_of_table(lut) == (None, 2.5)
    computed = {"exposure": {"iso": 200}, "body": {"sensor_noise_e": 2.8}}
    object.__setattr__(lut.provenance, "computed", computed)
    iso = parse_iso("1600", *known_of_table(lut))
    assert (iso.ratio, iso.sensor_electrons) == (8.0, 2.8)
    assert parse_iso("1600/200:read=3", *known_of_table(lut)).describe() == {
        "wanted": 1600.0,
        "table": 200.0,
        "sensor_electrons": 3.0,
    }
    with pytest.raises(InputError, match=r"ISO 100.*200.*1600"):
        parse_iso("1600/100", *known_of_table(lut))
    with pytest.raises(InputError):
        parse_iso("100", *known_of_table(lut))
