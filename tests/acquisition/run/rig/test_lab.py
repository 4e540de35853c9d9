"""Every device of a real lab is opened, and the faults of all are named at once."""

from __future__ import annotations

import itertools
from contextlib import ExitStack
from typing import Any
from unittest.mock import Mock

import pytest

from acquisition.run.rig import lab as rig
from experiment.config import LabSettings, parse_lab
from foundation.errors import ConfigurationError, DeviceError, LinkClosed

DEVICES = ("camera", "display", "projector")
FAULTY = [chosen for count in (1, 2, 3) for chosen in itertools.combinations(DEVICES, count)]

SAYS = {
    "camera": "the camera is asleep; wake it up",
    "display": "HDMI-1 is covered; close what covers it",
    "projector": "nobody answers at 192.0.2.7; look at its cable",
}


class Broken:
    """A device all of whose verbs fail but that it can be closed."""

    def __init__(self, says: str) -> None:
        self._says = says

    def close(self) -> None:
        """Do nothing."""

    def __getattr__(self, name: str) -> Any:
        def fail(*_: object) -> None:
            raise LinkClosed(self._says)

        return fail


def lab_settings() -> LabSettings:
    return parse_lab('rig = "lab"\nchart = "c"\nilluminations = "i"\n', "LAB.toml")


@pytest.mark.parametrize("faulty", FAULTY, ids="+".join)
def test_every_device_of_a_real_lab_is_opened_though_another_fails(
    monkeypatch: pytest.MonkeyPatch, faulty: tuple[str, ...]
) -> None:
    closed: list[str] = []
    places = {"camera": "_lab_camera", "projector": "_lab_projector", "display": "FullScreen"}
    if faulty != ("display",):
        # Nothing is shown while another device is at fault: another program may be at work with it.
        places["display"] = "display_warnings"
        monkeypatch.setattr(rig, "FullScreen", None)

    class Sound:
        def __init__(self, name: str) -> None:
            self._name = name

        def identity(self) -> str:
            return self._name

        def close(self) -> None:
            closed.append(self._name)

    for name, place in places.items():

        def opens(*_: object, name: str = name) -> Sound:
            if name in faulty:
                raise LinkClosed(SAYS[name])
            return Sound(name)

        monkeypatch.setattr(rig, place, opens)
    with pytest.raises(DeviceError) as told, ExitStack() as opened:
        rig.open_lab(lab_settings(), None, opened)
    for name in DEVICES:
        assert (SAYS[name] in str(told.value)) == (name in faulty)
    # What was opened is closed, whatever failed beside it.
    assert sorted(closed) == sorted({"camera", "projector"} - set(faulty))


@pytest.mark.parametrize("silent", [("camera",), ("projector",), ("camera", "projector")], ids="+".join)
def test_a_device_that_opens_and_does_not_answer_is_told_beside_one_that_does_not_open(
    monkeypatch: pytest.MonkeyPatch, silent: tuple[str, ...]
) -> None:
    def no_display(*_: object) -> None:
        raise ConfigurationError(SAYS["display"])

    class Sound:
        def identity(self) -> None:
            pass

        def close(self) -> None:
            pass

    monkeypatch.setattr(rig, "display_warnings", no_display)
    for name in ("camera", "projector"):

        def opens(*_: object, name: str = name) -> Broken | Sound:
            return Broken(SAYS[name]) if name in silent else Sound()

        monkeypatch.setattr(rig, f"_lab_{name}", opens)
    with pytest.raises(DeviceError) as told, ExitStack() as opened:
        rig.open_lab(lab_settings(), None, opened)
    for name in DEVICES:
        assert (SAYS[name] in str(told.value)) == (name in (*silent, "display"))


def test_faults_of_the_settings_alone_are_the_settings_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rig, "display_warnings", Mock(return_value=()))
    text = 'rig = "lab"\nchart = "c"\nilluminations = "i"\n[lab.camera]\nconnection = "ptpip"\n'
    settings = parse_lab(text + '[lab.projector]\ncontrol = "pjlink"\n', "LAB.toml")
    with pytest.raises(ConfigurationError) as told, ExitStack() as opened:
        rig.open_lab(settings, None, opened)
    for key in ("lab.camera.host", "lab.projector.host"):
        assert f"{key} is missing" in str(told.value)
    assert told.value.exit_code == 2
