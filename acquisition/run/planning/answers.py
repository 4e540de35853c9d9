"""What the devices say before a run; nothing is set, lit, released or shown for it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from acquisition.run.devices import Devices
from acquisition.run.lamp import reported_error
from drivers.camera import CameraIdentity, ReportsSupplies, Supplies
from drivers.presenter import ReportsWarnings
from drivers.projector import Power, Projector
from foundation.errors import CropError, DeviceError

_Answer = TypeVar("_Answer")


@dataclass(frozen=True)
class Answers:
    """What the devices said.

    - `camera`: who it is; None if it could not be asked.
    - `offered_s`: shutter times that it offers, seconds; empty if it lists none.
    - `supplies`: its battery and card; None if it does not tell.
    - `projector`: its name and state, in words; empty where there is none under control.
    - `lit`: whether its lamp burns; None if that is not known.
    - `warnings`: what changes the light behind the codes, each with its remedy.
    - `unasked`: what could not be asked, and why.
    - `faults`: what would end the run.
    """

    camera: CameraIdentity | None = None
    offered_s: tuple[float, ...] = ()
    supplies: Supplies | None = None
    projector: str = ""
    lit: bool | None = None
    warnings: tuple[str, ...] = ()
    unasked: tuple[str, ...] = ()
    faults: tuple[CropError, ...] = ()


def ask(devices: Devices) -> Answers:
    """Ask open devices for what a plan needs; a device that does not answer is a fault, the others are asked."""
    faults: list[CropError] = []
    unasked: list[str] = []

    def answer(question: Callable[[], _Answer], otherwise: _Answer) -> _Answer:
        try:
            return question()
        except DeviceError as fault:
            faults.append(fault)
            return otherwise

    camera, projector, presenter = devices.camera, devices.projector, devices.presenter
    identity = answer(camera.identity, None)
    offered: tuple[float, ...] = ()
    supplies: Supplies | None = None
    # A camera that cannot be reached is asked once: each question would wait for it.
    if identity is not None:
        offered = answer(camera.shutter_speeds, ())
        if not offered:
            unasked.append("shutter times: the camera lists none")
        if isinstance(camera, ReportsSupplies):
            supplies = answer(camera.supplies, None)
        if supplies is None or (supplies.battery is None and not supplies.mains):
            unasked.append("battery: the camera does not tell; see that it runs on mains power")
        unasked.append("ISO speed and aperture: they are set and verified before the lamp is lit")
    state, lit = "", None
    if projector is not None:
        state, lit = answer(lambda: _state(projector), ("", None))
        if lit is not None:
            error = answer(lambda: reported_error(projector), None)
            faults += [] if error is None else [error]
    else:
        unasked.append("lamp: the projector is not under control; switch it on half an hour before")
    warnings: tuple[str, ...] = ()
    if isinstance(presenter, ReportsWarnings):
        warnings = answer(presenter.warnings, ())
    return Answers(identity, offered, supplies, state, lit, warnings, tuple(unasked), tuple(faults))


def _state(projector: Projector) -> tuple[str, bool | None]:
    """Return who a projector is and how its lamp is, in words; and whether it burns."""
    identity = projector.identity()
    name = " ".join(word for word in (identity.maker, identity.model, identity.name) if word) or "projector"
    hours = ", ".join(f"{lamp.hours} h" for lamp in projector.lamps())
    power = projector.power()
    lit = power is Power.ON
    state = "its lamp burns and is taken as warm" if lit else f"in {power.value}: it will be lit"
    return f"{name}{f', lamp {hours}' if hours else ''}, {state}", lit
