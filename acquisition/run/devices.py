"""What a session is taken with, as the sequencer knows it: by the contracts of `drivers` only."""

from __future__ import annotations

from dataclasses import dataclass

from drivers.camera import Camera
from drivers.presenter import Presenter
from drivers.projector import Projector
from foundation.clock import Clock


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
