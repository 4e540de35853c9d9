"""All devices of a real laboratory are opened, and all faults are reported together."""

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
def test_reports_faults_of_all_devices(monkeypatch: pytest.MonkeyPatch, faulty: tuple[str, ...]) -> None:
    closed: list[str] = []
    openers = {"camera": "_lab_camera", "projector": "_lab_projector", "display": "FullScreen"}
    if faulty != ("display",):
        # Nothing is shown if a device has a fault: another program may be using it.
        openers["display"] = "display_warnings"
        monkeypatch.setattr(rig, "FullScreen", None)

    for name, opener in openers.items():
        sound = Mock()
        sound.close.side_effect = partial(closed.append, name)
        monkeypatch.setattr(rig, opener, Mock(side_effect=[LinkClosed(SAYS[name]) if name in faulty else sound]))
    with pytest.raises(DeviceError) as caught, ExitStack() as opened:
        rig.open_lab(lab_settings(), None, opened)
    for name in DEVICES:
        assert (SAYS[name] in str(caught.value)) == (name in faulty)
    # All opened devices are closed after a fault.
    assert sorted(closed) == sorted({"camera", "projector"} - set(faulty))


@pytest.mark.parametrize("silent", [("camera",), ("projector",), ("camera", "projector")], ids="+".join)
def test_reports_silent_and_closed_devices_together(monkeypatch: pytest.MonkeyPatch, silent: tuple[str, ...]) -> None:
    monkeypatch.setattr(rig, "display_warnings", Mock(side_effect=ConfigurationError(SAYS["display"])))
    for name in ("camera", "projector"):
        device = Broken(SAYS[name]) if name in silent else Mock()
        monkeypatch.setattr(rig, f"_lab_{name}", Mock(return_value=device))
    with pytest.raises(DeviceError) as caught, ExitStack() as opened:
        rig.open_lab(lab_settings(), None, opened)
    for name in DEVICES:
        assert (SAYS[name] in str(caught.value)) == (name in (*silent, "display"))


def test_faults_of_settings_are_configuration_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rig, "display_warnings", Mock(return_value=()))
    text = 'rig = "lab"\nchart = "c"\nilluminations = "i"\n[lab.camera]\nconnection = "ptpip"\n'
    settings = parse_lab(text + '[lab.projector]\ncontrol = "pjlink"\n', "LAB.toml")
    with pytest.raises(ConfigurationError) as caught, ExitStack() as opened:
        rig.open_lab(settings, None, opened)
    for key in ("lab.camera.host", "lab.projector.host"):
        assert f"{key} is missing" in str(caught.value)
    assert caught.value.exit_code == 2
