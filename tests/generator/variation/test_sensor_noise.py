"""Measured noise of look-up tables (LUTs), and noise at higher ISO speeds."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from calibration.citation import OriginRecord
from calibration.table.lut import Lut
from foundation.errors import InputError
from generator.variation.iso_speed import IsoSpeed, parse_iso, recorded_speed
from generator.variation.sensor_noise import SensorNoise, Three, measured_noise
from sim.world.sensors import BODIES
from tests.generator.conftest import MakeLut


def table(read: float, shot: float, response: float = 0.0, texture: float = 0.0, unfit: tuple[int, ...] = ()) -> Lut:
    """Return a LUT stand-in of 512 colours under 8 illuminants with camera noise, for `measured_noise`."""
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
def test_measures_noise_of_simulated_samples(response: float) -> None:
    noise = measured_noise(table(6.0, 0.55, response, unfit=(3, 400)))
    assert noise.read == pytest.approx([6.0] * 3, rel=0.05)
    assert noise.shot == pytest.approx([0.55] * 3, rel=0.04)


def test_refuses_samples_without_photon_transfer() -> None:
    # Patches of a coarse print: their variance does not depend on their level.
    lut = table(1.0, 0.1)
    rng = np.random.default_rng(2)
    noisy_samples = np.asarray(lut.samples).astype(np.float64) + rng.choice([0, 40], (8, 512, 1, 1)) * rng.normal(
        size=(8, 512, 25, 1)
    )
    counts = noisy_samples.clip(1, 65535).astype(np.uint16)
    vars(lut).update(samples=counts, light_samples=counts.__getitem__)
    with pytest.raises(InputError):
        measured_noise(lut)


def test_refuses_too_few_patches(make_lut: MakeLut) -> None:
    with pytest.raises(InputError):
        measured_noise(make_lut(bits=1, lights=1))


def test_measures_poisson_noise(make_lut: MakeLut) -> None:
    noise = measured_noise(make_lut(bits=3))
    assert noise.shot == pytest.approx([1.0] * 3, rel=0.1)


def test_accepts_speeds_above_0() -> None:
    assert IsoSpeed(0.5, 0.25, 0.0).ratio == 2
    for speeds in ((0.0, 100.0, 1.0), (100.0, 0.0, 1.0), (100.0, 100.0, -0.1), (100.0, 100.0, 1e6), (np.inf, 1.0, 1.0)):
        with pytest.raises(InputError):
            IsoSpeed(*speeds)
    with pytest.raises(InputError):
        IsoSpeed(199.9, 200)


def test_higher_speed_matches_simulated_bodies() -> None:
    # The data of a body give its read noise before the amplifier; green is the mean of two photosites.
    for body in BODIES.values():
        noise = SensorNoise(*_of_body(body, 100)).at(16, body.sensor_noise_e)
        read, shot = _of_body(body, 1600)
        assert noise.read == pytest.approx(read, rel=1e-5)
        assert noise.shot == pytest.approx(shot, rel=1e-5)


def _of_body(body: Any, iso: int) -> tuple[Three, Three]:
    read, gain = body.noise_dn(iso), body.gain_e(iso)
    return (read, read / 2**0.5, read), (1 / gain, 0.5 / gain, 1 / gain)


def test_read_noise_before_amplifier_is_limited_by_total() -> None:
    assert SensorNoise((2.0, 2.0, 2.0), (1.0, 1.0, 1.0)).at(10, 100.0).read == pytest.approx([20.0] * 3)
    assert SensorNoise((2.0, 2.0, 2.0), (1.0, 1.0, 1.0)).at(10, 0.0).read == pytest.approx([2.0] * 3)


def test_speed_of_photographed_table() -> None:
    lut = table(6.0, 0.55)
    object.__setattr__(lut.provenance, "origin", OriginRecord(iso=400))
    assert recorded_speed(lut) == (400.0, 2.5)
    assert parse_iso("1600", *recorded_speed(lut)).ratio == 4
    with pytest.raises(InputError, match=r"ISO 100.*400"):
        parse_iso("1600/100", *recorded_speed(lut))
    object.__setattr__(lut.provenance, "origin", OriginRecord())
    assert recorded_speed(lut) == (None, 2.5)


def test_speed_of_computed_table() -> None:
    lut = table(6.0, 0.55)
    assert recorded_speed(lut) == (None, 2.5)
    computed = {"exposure": {"iso": 200}, "body": {"sensor_noise_e": 2.8}}
    object.__setattr__(lut.provenance, "computed", computed)
    iso = parse_iso("1600", *recorded_speed(lut))
    assert (iso.ratio, iso.sensor_electrons) == (8.0, 2.8)
    assert parse_iso("1600/200:read=3", *recorded_speed(lut)).describe() == {
        "wanted": 1600.0,
        "table": 200.0,
        "sensor_electrons": 3.0,
    }
    with pytest.raises(InputError, match=r"ISO 100.*200.*1600"):
        parse_iso("1600/100", *recorded_speed(lut))
    with pytest.raises(InputError):
        parse_iso("100", *recorded_speed(lut))
