"""Every device of a real lab is opened, and the faults of all are named at once."""

from __future__ import annotations

from contextlib import ExitStack
from functools import partial
from unittest.mock import Mock

import pytest

from acquisition.run.rig import lab as rig
from experiment.config import LabSettings, parse_lab
from foundation.errors import ConfigurationError, DeviceError, LinkClosed
from tests.acquisition.run.scripted import DEVICES, FAULTY, SAYS, Broken


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

    for name, place in places.items():
        sound = Mock()
        sound.close.side_effect = partial(closed.append, name)
        monkeypatch.setattr(rig, place, Mock(side_effect=[LinkClosed(SAYS[name]) if name in faulty else sound]))
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
    monkeypatch.setattr(rig, "display_warnings", Mock(side_effect=ConfigurationError(SAYS["display"])))
    for name in ("camera", "projector"):
        device = Broken(SAYS[name]) if name in silent else Mock()
        monkeypatch.setattr(rig, f"_lab_{name}", Mock(return_value=device))
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
