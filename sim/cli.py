"""Command `sim`: simulated devices on real connections, to try this or other software without hardware."""

from __future__ import annotations

import queue
import signal
import tomllib
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from foundation import console
from foundation.clock import SystemClock
from foundation.console import EXIT_CODES, new_app, option
from foundation.errors import ConfigurationError, InputError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from sim.camera.film import Film
    from sim.projectors.projector import SimulatedProjector
    from sim.world.rendering import Print
    from sim.world.world import World

app = new_app(
    "Simulated devices on loopback connections, and computed look-up tables (LUTs).\n\n" + EXIT_CODES,
    no_args_is_help=True,
)


def main(argv: Sequence[str] | None = None, read_chart: Callable[[Path], Print] | None = None) -> int:
    """Run `sim` with `argv`, by default the arguments of the process, and return the exit code (`EXIT_CODES`).

    `read_chart` returns the print that a file chart.json describes.
    """
    return console.run(lambda: app(args=argv, prog_name="sim", obj=read_chart))


@app.command()
def projector(
    pjlink: Annotated[int | None, typer.Option(min=0, max=65535, help="TCP port for PJLink; 0 for a free one.")] = None,
    password: Annotated[str | None, typer.Option(help="PJLink password, at most 32 characters.")] = None,
    serial: Annotated[
        str | None,
        option("LANGUAGE", "Language of the serial port: a name (docs/devices.md), or a language file (.toml)."),
    ] = None,
    lit: Annotated[bool, typer.Option("--lit", help="Start with the lamp on instead of in standby.")] = False,
    warm_up: Annotated[float, option("SECONDS", "Duration of warm-up.", min=0)] = 30.0,
    cool_down: Annotated[float, option("SECONDS", "Duration of cooling.", min=0)] = 60.0,
) -> None:
    """Serve a simulated projector that needs time to warm up and to cool down.

    With --pjlink, the projector listens on a TCP port. With --serial, it uses a pseudo-terminal (Linux and macOS),
    which any program for serial ports can open. The command prints the address or path and serves until Ctrl-C. It
    reads a file only if --serial names a language file, and writes no file.

    Exit code 0 after Ctrl-C. Exit code 2 if the language is unknown, or if both or neither of --pjlink and --serial are
    given. Exit code 3 if the port is in use.
    """
    from drivers.pjlink import MAX_PASSWORD
    from drivers.projector import Power
    from sim.projectors.pjlink import serve_pjlink
    from sim.projectors.projector import ProjectorTraits, SimulatedProjector

    if (pjlink is None) == (serial is None):
        raise ConfigurationError("expected exactly one of --pjlink PORT and --serial LANGUAGE; give one of them")
    if pjlink is None and password is not None:
        raise ConfigurationError("--password is given, but --serial has no password; omit it")
    if password is not None and not 1 <= len(password) <= MAX_PASSWORD:
        raise InputError(
            f"the password has {len(password)} characters, expected 1 to {MAX_PASSWORD} (PJLink); choose another"
        )
    traits = ProjectorTraits(warm_up_s=warm_up, cool_down_s=cool_down)
    device = SimulatedProjector(SystemClock(), Power.ON if lit else Power.STANDBY, traits)
    if serial is not None:
        _serve_serial(device, serial)
    elif pjlink is not None:
        with serve_pjlink(device, pjlink, password) as server:
            _until_interrupted("PJLink projector at {}:{}".format(*server.address))


def _serve_serial(device: SimulatedProjector, language_name: str) -> None:
    from drivers.serial_projectors.language import load_language

    language = load_language(language_name)
    try:
        from sim.buses.serial import PseudoTerminal
    except ImportError as error:
        raise ConfigurationError("this system has no pseudo-terminals, which --serial needs; use --pjlink") from error
    from sim.projectors.serial import LinePeer

    with PseudoTerminal(LinePeer(device, language)) as terminal:
        _until_interrupted(f"{language.maker} projector at {terminal.path}")


@app.command()
def camera(
    context: typer.Context,
    port: Annotated[int, typer.Option(min=0, max=65535, help="TCP port for PTP/IP; 0 for a free one.")] = 15740,
    model: Annotated[
        str,
        typer.Option(
            help="EOS 550D, EOS 6D Mark II, or Test, which has small frames; or spectral sensitivities by name or "
            "file, as in sim table --camera."
        ),
    ] = "EOS 550D",
    chart: Annotated[Path | None, typer.Option(help="chart.json of the print; by default grey squares.")] = None,
    room: Annotated[
        list[str] | None, option("NAME=VALUE", "Parameter of the simulated room, as in LAB.toml; can be repeated.")
    ] = None,
    watch_screen: Annotated[
        str | None,
        option("SCREEN", "X display or part of it that illuminates the chart: :1, 640x360+0+0, or :1,640x360+0+0."),
    ] = None,
    watch_projector: Annotated[
        str | None, option("HOST:PORT", "PJLink projector of the watched screen; by default a constant lamp.")
    ] = None,
) -> None:
    """Serve a simulated Canon EOS on a TCP port; by default it photographs grey squares under white light.

    With --watch-screen, the picture on that screen illuminates the chart, in real time. A window that covers the screen
    during half of the exposure contributes half of its light. With --watch-projector, power, mute, freeze and input of
    that projector also change the light. These options allow rehearsals of `acquire` (docs/how-to/rehearsal.md).

    The command prints its address and serves until Ctrl-C. With --watch-screen, it also prints the progress of each
    exposure. It reads the files of --chart and --model, and writes no file.

    Exit code 0 after Ctrl-C. Exit code 2 if the model, chart, room or screen is wrong. Exit code 3 if the port is in
    use or the screen cannot be read.

    Any software that supports PTP/IP can use this camera. Both connections of PTP/IP use the same port. Example:

    gphoto2 --camera "PTP/IP Camera" --port ptpip:127.0.0.1:15740:15740 --capture-image-and-download
    """
    from drivers.canon import SHUTTER
    from drivers.ptp.codes import Property
    from sim.buses.ptp import serve_ptpip
    from sim.camera.bodies import eos_with
    from sim.camera.eos import SimulatedEos
    from sim.world.sensors import find_body
    from sim.world.world import REFERENCE_EXPOSURE, World, read_room

    sensor = find_body(model)
    if watch_screen is None and watch_projector is not None:
        raise ConfigurationError("--watch-projector is given without --watch-screen; give both")
    changes = dict(_setting("--room", text) for text in room or ())
    # Lamp drift is off by default. It would count from `SIM_START`, so long ago that the lamp would now be dark.
    world = World(
        _grey_squares() if chart is None else _print(context, chart),
        sensor,
        read_room(_SEED, {"lamp_drift_per_hour": 0.0} | changes, "the command line", "--room"),
    )
    with ExitStack() as resources:
        film = resources.enter_context(_film(world, watch_screen, watch_projector))
        # A frame may be exposed while earlier frames are still calculated.
        executor = resources.enter_context(ThreadPoolExecutor(3, "developing"))
        eos = SimulatedEos(eos_with(sensor, model), film, SystemClock(), auto_power_off_s=0, executor=executor)
        eos.set_menu(Property.EOS_SHUTTER_SPEED, SHUTTER.code(REFERENCE_EXPOSURE.shutter_s))
        with serve_ptpip(eos, port, name=eos.body.model) as server:
            _until_interrupted("PTP/IP camera {} at {}:{}".format(eos.body.model, *server.address))


_SEED = 1  # Seed of all random values of the simulated room: paper, lamp, noise.


@contextmanager
def _film(world: World, screen: str | None, projector: str | None) -> Generator[Film]:
    from drivers.links.network import TcpLink
    from drivers.pjlink import PjLinkProjector
    from drivers.presenter import WHITE
    from sim.camera.film import WatchedFilm, WorldFilm
    from sim.projectors.watching import Beam, ScreenPlace, Screenshots
    from sim.world.world import REFERENCE_EXPOSURE

    serial = "0000000001"
    if screen is None:
        yield WorldFilm(world, lambda: WHITE, lambda: 1.0, serial, {})
        return
    clock, pictures = SystemClock(), Screenshots(ScreenPlace.parse(screen))
    # A screen that is missing at the start is an error of the user. A screen that fails later is part of the rehearsal.
    pictures.take()
    pjlink_projector = None
    if projector is not None:
        host, port = _host_and_port(projector)
        pjlink_projector = PjLinkProjector(lambda: TcpLink.connect(host, port, 5.0), label=projector, clock=clock)
        pjlink_projector.power()
    with Beam(pictures, pjlink_projector, world.room.light_of, clock) as beam:
        # Renders the room now, so that the first frame is not delayed by seconds.
        world.signal(WHITE, REFERENCE_EXPOSURE)

        def measure_light(number: int, seconds: float) -> tuple[NDArray[np.float32], float]:
            print(f"exposure {number} starts, {seconds:g} s", flush=True)
            projected = beam.measure_exposure(seconds, lambda: print(f"exposure {number} half over", flush=True))
            dark = f"; no light: {beam.trouble}" if beam.trouble else ""
            print(f"exposure {number} ends: {projected}{dark}", flush=True)
            return projected.picture, projected.lamp

        yield WatchedFilm(world, measure_light, serial, clock.now())


def _print(context: typer.Context, chart: Path) -> Print:
    read: Callable[[Path], Print] | None = context.obj
    if read is None:
        raise ConfigurationError(f"--chart {chart} cannot be read by sim.cli; use the program sim")
    return read(chart)


def _setting(option: str, text: str) -> tuple[str, Any]:
    # Values are in TOML syntax, but texts need no quotes.
    name, equals, value = text.partition("=")
    if not name or not equals:
        raise InputError(f"{option} is {text!r}, expected NAME=VALUE, such as waviness_mm=1.5; correct it")
    try:
        return name, tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        return name, value


def _grey_squares() -> Print:
    # An A4 sheet with 5 × 3 squares from black to paper white.
    import numpy as np

    from sim.world.rendering import Print

    column, row = (grid.ravel() for grid in np.meshgrid(np.arange(5), np.arange(3)))
    x, top = 18 + 54.0 * column, 21 + 60.0 * row
    boxes = np.stack([x, top, x + 45, top + 45], axis=-1).astype(np.float64)
    grey = np.linspace(0, 248, len(x)).round().astype(np.uint8)
    return Print((297, 210), boxes, np.stack([grey] * 3, axis=-1))


def _host_and_port(text: str) -> tuple[str, int]:

    host, _, port = text.rpartition(":")
    if not host or not port.isascii() or not port.isdigit() or not 1 <= int(port) <= 65535:
        raise InputError(f"the address is {text!r}, expected HOST:PORT, such as 127.0.0.1:4352; correct it")
    return host, int(port)


def _until_interrupted(announcement: str) -> None:
    """Print the address and serve until Ctrl-C or SIGTERM, even if the parent process ignores them."""
    signals = queue.SimpleQueue[int]()
    for request in (signal.SIGINT, signal.SIGTERM):
        signal.signal(request, lambda number, _: signals.put(number))
    # Handlers are set before the address is printed, because a program that reads it may send a signal at once.
    print(announcement, flush=True)
    signals.get()
    print("stopped")


if __name__ == "__main__":
    raise SystemExit(main())
