"""The command `sim` as users run it."""

from __future__ import annotations

from pathlib import Path

import pytest

import sim
from drivers.canon import CanonEos
from drivers.links.network import TcpLink, TcpServer
from drivers.pjlink import PjLinkProjector
from drivers.projector import Power
from drivers.ptp.ip import IpTransport
from foundation.clock import SystemClock
from sim.cli import main
from sim.spectral import SUFFIX
from sim.world.sensors import find_body
from tests.drivers.display.x_servers import virtual_screen
from tests.sim.conftest import sim_serving


@pytest.mark.slow
def test_serves_a_projector_until_interrupted() -> None:
    with sim_serving("projector", "--pjlink", "0", "--password", "secret") as (line,):
        host, port = line.split()[-1].split(":")
        projector = PjLinkProjector(lambda: TcpLink.connect(host, int(port), 10.0), "secret", 10.0)
        projector.switch_on()
        assert projector.power() is Power.WARMING
    projector.close()


@pytest.mark.slow
@pytest.mark.parametrize(
    "arguments",
    [["projector", "--pjlink"], ["camera", "--model", "Test", "--port"]],
)
def test_used_port_is_one_line(capsys: pytest.CaptureFixture[str], arguments: list[str]) -> None:
    with TcpServer(lambda link: None) as server:
        assert main([*arguments, str(server.address[1])]) == 3
    error = capsys.readouterr().err
    assert error.startswith("error: cannot listen at 127.0.0.1:")
    assert error.count("\n") == 1


def test_missing_screen_or_projector_exits_with_3(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    arguments = ["camera", "--port", "0", "--model", "Test", "--watch-screen"]
    assert main([*arguments, ":999"]) == 3
    assert "check :999" in capsys.readouterr().err
    with TcpServer(lambda link: None) as server:
        port = server.address[1]
    with virtual_screen(tmp_path, "64x48") as screen:
        assert main([*arguments, screen.display, "--watch-projector", f"127.0.0.1:{port}"]) == 3
    assert f"nothing listens at 127.0.0.1:{port}" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("model", ["Canon_EOS_5DS", "mine.json", "Test", "EOS 6D Mark II"])
def test_camera_takes_sensitivities(model: str, tmp_path: Path) -> None:
    names = {
        "Canon_EOS_5DS": "Canon EOS 5DS",
        "Test": "Canon CroP Test",
        "EOS 6D Mark II": "Canon EOS 6D Mark II",
    }
    if model == "mine.json":
        source = Path(sim.__file__).parent / "data" / f"Canon_EOS_5DS{SUFFIX}"
        text = source.read_text().replace('"Canon"', '"Nikon"').replace('"EOS 5DS"', '"D810"')
        (tmp_path / model).write_text(text)
        model = str(tmp_path / model)
    with sim_serving("camera", "--port", "0", "--model", model) as (line,):
        host, port = line.split()[-1].split(":")
        clock = SystemClock()
        camera = CanonEos(lambda: IpTransport.connect(host, int(port), guid=bytes(16), name="test", clock=clock), clock)
        name = camera.identity().name
        camera.close()
    assert name == find_body(model).camera
    assert name == names.get(model, "Nikon D810")


def test_unknown_camera_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["camera", "--port", "0", "--model", "Canon_EOS_600"]) == 2
    assert "did you mean 'Canon_EOS_600D'" in capsys.readouterr().err


@pytest.mark.slow
def test_projector_has_the_given_warm_up_time() -> None:
    options = ("--warm-up", "0", "--cool-down", "0")
    with sim_serving("projector", "--pjlink", "0", *options) as (line,):
        host, port = line.split()[-1].split(":")
        projector = PjLinkProjector(lambda: TcpLink.connect(host, int(port), 10.0), timeout=10.0)
        projector.switch_on()
        assert projector.power() is Power.ON
        projector.switch_off()
        assert projector.power() is Power.STANDBY
        projector.close()
