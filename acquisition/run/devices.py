"""What a session is taken with, by the contracts of `drivers` only, and how all of it is asked at once.

Every device is asked, also when another one failed: whoever repairs a cable wants to know of the other one too, since
each walk to the lab costs more than all questions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from drivers.camera import Camera
from drivers.presenter import Presenter
from drivers.projector import Projector
from foundation.clock import Clock
from foundation.errors import ConfigurationError, CropError, DeviceError


@dataclass(frozen=True)
class Devices:
    """The open devices of a rig.

    - `camera`: takes the frames.
    - `presenter`: fills the projector's picture with one plain colour.
    - `projector`: the control port of the projector; None where its lamp is not under control.
    - `clock`: measures and makes every pause.
    """

    camera: Camera
    presenter: Presenter
    projector: Projector | None
    clock: Clock


Questions = Mapping[str, Callable[[], object]]
"""What is asked, by the name of the device; each raises what its device says against it."""


def ask_all(questions: Questions, further: Questions | None = None) -> None:
    """Ask each question, and raise what went wrong with all of them together."""
    faults = _faults_of(questions)
    if not faults:
        return
    faults |= _faults_of({name: question for name, question in (further or {}).items() if name not in faults})
    if len(faults) == 1:
        raise next(iter(faults.values()))
    of_settings = all(isinstance(fault, ConfigurationError) for fault in faults.values())
    kind = ConfigurationError if of_settings else DeviceError
    listed = "".join(f"\n  {name}: {fault}" for name, fault in faults.items())
    raise kind(f"{len(faults)} of {len(questions)} devices cannot be used:{listed}") from next(iter(faults.values()))


def _faults_of(questions: Questions) -> dict[str, CropError]:
    faults: dict[str, CropError] = {}
    for name, question in questions.items():
        try:
            question()
        except (DeviceError, ConfigurationError) as fault:
            faults[name] = fault
    return faults
