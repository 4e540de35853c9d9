"""Pinned frames of small rooms, and pinned illuminants, inks and shapes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, get_args

import numpy as np
import pytest

from drivers.camera import ExposureSettings
from drivers.presenter import BLACK, WHITE, Colour
from sim import spectral
from sim.spectral import daylight, projector_primaries
from sim.world.disturbances import AnyDisturbance, Disturbances, Moment
from sim.world.sensors import BODIES, SENSITIVITY_BODIES, Body, Rectangle, find_body
from sim.world.world import REFERENCE_EXPOSURE, UNDISTURBED, Blob, Glare, Patch, Room, Situation, World
from tests.pinned import Pinned
from tests.sim.conftest import patches

TINY = replace(
    BODIES["Test"], sensor=(131, 187), visible=Rectangle(11, 16, 117, 166), masked=(Rectangle(0, 0, 131, 14),)
)
ORANGE = Colour(255, 140, 11)
BRIGHT = ExposureSettings(800, 5.6, 0.25)
PLACES = np.stack(np.meshgrid([-3.0, 75.5, 181], [0.0, 40.2, 125]), axis=-1)
SINGLE = 1e-5
"""Single precision, in which photosites are rendered, to a few of its last digits."""
COUNT = 2e-4
"""Single precision may move a photosite over the edge between two counts."""

ROOMS: dict[str, tuple[Room, Body]] = {
    "usual": (Room(seed=4), TINY),
    "bent": (
        Room(seed=1, fill=0.7, focal_diagonals=0.9, tilt_deg=7, pan_deg=5, roll_deg=-4, k1=-0.12, k2=0.05, p1=2e-3,
             p2=-1e-3, waviness_mm=30, wave_mm=260, curl_mm=25, blur_px=1.1, vignetting=0.5, projector_falloff=0.4,
             primary_difference=0.4, response_spread=0),
        replace(TINY, pattern="GBRG"),
    ),
    "of a poor lens": (
        Room(seed=2, shoulder_share=0.05, shoulder_px=2.5, veil=0.03, lateral_red_px=0.8, lateral_blue_px=-0.6),
        replace(TINY, pattern="BGGR"),
    ),
    "lit by diodes": (
        Room(seed=3, lamp_spectrum="led", transfer=2.4, black_leak=0.01, ambient=0.02, white_level_share=1.1,
             paper="matt", wheel_hz=37, shutter_jitter_s=0.002),
        replace(TINY, pattern="GRBG", sensitivities="Canon_EOS_200D", black=511, saturation=15000, bits=14),
    ),
    "worn": (
        Room(seed=5, stain_mm=40, stain_depth=0.6, fold_mm=4, hot_per_million=1500, hot_dn_per_s=9000, paper="glossy"),
        TINY,
    ),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", ROOMS)
def test_rooms_are_unchanged(name: str, pinned: Pinned) -> None:
    room, body = ROOMS[name]
    world = World(patches(), body, room)
    rgb = np.array([[0, 0, 0], [255, 255, 255], [200, 30, 90], [3, 128, 254]])
    values: dict[str, Any] = {
        "exposed": [
            world.expose(WHITE, REFERENCE_EXPOSURE, key=(1,)),
            world.expose(ORANGE, BRIGHT, key=(2, 3), lamp=0.8, situation=Situation(black_dn=7.5)),
            world.expose(BLACK, ExposureSettings(100, None, 2.0), key=(0,)),
        ],
    }
    pinned(f"frames of a room, {name}", values, same=COUNT)
    spots = PLACES[:2, :2].reshape(-1, 2)
    values = {
        "signal": [world.signal(WHITE, REFERENCE_EXPOSURE), world.signal(ORANGE, BRIGHT, 0.7)],
        "seen at": np.stack([world.project(PLACES, channel) for channel in "RGGB"]),
        "found at": world.view.locate(np.array([[-4.0, -2], [20, 30], [82, 58], [50.3, 11.1]])),
        "unshifted": np.stack([world.lens.unshifted(PLACES, channel) for channel in "RGGB"]),
        "light at": np.stack([world.field(PLACES), world.worn_light(PLACES), world.field(PLACES[::-1])]),
        "white": world.white(ORANGE, BRIGHT, 1.5),
        "reflected": world.reflected(rgb, ORANGE, BRIGHT),
        "seen": world.camera_rgb_at(rgb, spots, ORANGE, BRIGHT, 0.9),
        "of primaries": world.signals_of_primaries(rgb, spots),
        "drive": world.drive(ORANGE, BRIGHT, np.array([1, 0.5, 2]), np.array([0, 0.1, 0.01])),
        "light of codes": room.light_of(np.arange(0, 256, 15)),
        "light of a wheel": [room.wheel_light(t, np.random.default_rng(8)) for t in (0.5, 0.01, 1 / 60)],
        "hot": world.hot,
        "stain and fold": [world.stain, world.fold],
        "shoulder": world.lens.kernel(),
        "noise": [[body.gain_e(iso), body.noise_dn(iso)] for iso in (100, 400, 6400)],
    }
    pinned(f"light of a room, {name}", values, same=SINGLE)


@pytest.mark.slow
def test_disturbances_are_unchanged(pinned: Pinned) -> None:
    world = World(patches(), TINY, Room(seed=6, veil=0.02, black_leak=0.002))
    # Earlier colours, and moments at the limits of events.
    moments = [
        Moment(n, 10.0 * n, ORANGE, ((10.0 * n - 10, WHITE), (10.0 * n - 0.5, Colour(0, 9, 200)))) for n in range(6)
    ]
    variants: dict[str, dict[str, Any]] = {
        "bump": {"px": 3.0, "mm": 1.5, "direction_deg": 200.0, "turn_deg": 1.2},
        "dead primary": {"primary": "blue"},
        "half-changed": {"share": 0.4},
        "lamp step": {"rgb": (1.0, -2.0, 5.0)},
        "lamp drift": {"rgb": (1.0, -2.0, 5.0)},
        "screen saver": {"share": 0.3, "seed": 7},
        "scrambled rows": {"seed": 5, "top": 0.11},
    }
    values: dict[str, Any] = {}
    for kind in get_args(AnyDisturbance):
        name = str(kind.what)
        for title, changes in ((name, {}), *([(f"{name}, other", variants[name])] if name in variants else [])):
            one = kind(from_frame=1, to_frame=4, from_s=None, to_s=None, **changes)
            timed = kind(from_s=15.0, to_s=40.0)
            events, active_moment = Disturbances((one,)), moments[2]
            situation = events.situation(active_moment)
            counts = np.arange(131 * 187, dtype=np.uint16).reshape(131, 187)
            counted = events.counted(counts, active_moment)
            values[title] = {
                "situation": {
                    name: one for name, one in vars(situation).items() if one is not getattr(UNDISTURBED, name)
                },
                "later": events.situation(moments[4]).lamp,
                "counted": None if np.array_equal(counted, counts) else counted,
                "at": [[len(group.at(moment)) for moment in moments] for group in (events, Disturbances((timed,)))],
                "signal": world.signal(events.shown(active_moment), BRIGHT, situation=situation),
                "stale": events.stale(active_moment) is not None,
            }
    pinned("a room's disturbances", values, same=SINGLE)


@pytest.mark.slow
def test_combined_disturbances_are_unchanged(pinned: Pinned) -> None:
    world = World(patches(), TINY, ROOMS["of a poor lens"][0])
    picture = np.random.default_rng(2).uniform(size=(5, 9, 3)).astype(np.float32)
    situations = {
        "picture": Situation(picture=picture),
        "plain picture": Situation(picture=picture[:1, :1]),
        "patches": Situation(patches=(Patch((0.1, 0.2, 0.6, 0.7), WHITE, 0.6), Patch((0.5, 0.5, 2, 2), ORANGE))),
        "blobs": Situation(blobs=(Blob((0.1, 0.1, 0.5, 0.9)), Blob((0.4, 0, 1.2, 0.5), 0.5)), lamp=(1, 0.5, 1.2)),
        "glares": Situation(glares=(Glare((0, 0, 0.7, 0.6)), Glare((0.5, 0.5, 1, 1), 0.2)), ambient=(0.1, 0, 0.05)),
        "all": Situation(picture=picture, patches=(Patch((0.1, 0.2, 0.6, 0.7), WHITE),), glares=(Glare((0, 0, 1, 1)),),
                         bump_px=(2, -1), bump_mm=(0.5, 3), turn_deg=-2, defocus_px=1.5),
    }  # fmt: skip
    values = {name: world.signal(ORANGE, BRIGHT, 1.1, one) for name, one in situations.items()}
    for name, room in (("stain", Room(stain_mm=40)), ("fold", Room(fold_mm=4)), ("curl", Room(curl_mm=9, wave_mm=90))):
        values[name] = World(patches(), TINY, room).signal(WHITE, REFERENCE_EXPOSURE)
    pinned("a room's situations", [values, world.project(PLACES, "R", situations["all"])], same=SINGLE)


def test_lights_and_cameras_are_unchanged(pinned: Pinned) -> None:
    values = {
        "lamps": {lamp: projector_primaries(lamp) for lamp in get_args(spectral.LampSpectrum)},
        "daylight": {str(k): daylight(k).power for k in (4000, 5003, 7000, 7001, 12000, 25000)},
        "cameras": {
            name: [spectral.sensitivities(name), spectral.describe_sensitivities(spectral.read_sensitivities(name))]
            for name in spectral.known_sensitivities()
            if name in SENSITIVITY_BODIES
        },
        "a body with changes": find_body("Canon_EOS_5DS", {"pixels": [64, 17], "black": 100, "read_noise_dn": 9.5}),
        "observer": spectral._observer(),
    }
    pinned("lights and cameras", values)
