"""`sim`: simulated devices on real cables, for trying the suite, or other software, without hardware."""

from __future__ import annotations

import signal
import threading
from collections.abc import Sequence
from contextlib import ExitStack
from typing import TYPE_CHECKING, Annotated

import typer

from foundation import console
from foundation.console import EXIT_CODES

if TYPE_CHECKING:
    from sim.projectors.projector import SimulatedProjector
    from sim.world.drawing import Print

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Simulated devices on loopback connections, until interrupted; and tables that are computed.\n\n" + EXIT_CODES,
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run `sim` with these arguments, or those of the process, and return the exit code (`EXIT_CODES`)."""
    return console.run(lambda: app(args=argv, prog_name="sim"))


@app.callback()
def _devices() -> None:  # pyright: ignore[reportUnusedFunction]  # typer calls it: one command alone would lose its name
    """Serve simulated devices on loopback connections, until interrupted."""


@app.command()
def projector(
    pjlink: Annotated[
        int | None, typer.Option(min=0, max=65535, help="TCP port for PJLink; 0 picks a free one.")
    ] = None,
    password: Annotated[str | None, typer.Option(help="PJLink password, at most 32 characters.")] = None,
    udp: Annotated[
        int | None, typer.Option(min=0, max=65535, help="UDP port where PJLink searches are answered; 0 picks one.")
    ] = None,
    notify: Annotated[
        str | None, typer.Option(metavar="HOST:PORT", help="Send PJLink status notices there, by UDP.")
    ] = None,
    serial: Annotated[str | None, typer.Option(help="Language on a serial port: benq, epson, nec or optoma.")] = None,
) -> None:
    """Serve a simulated projector: standby, 30 s of warm-up, on, 60 s of cooling.

    Reads and writes no file. With --pjlink it listens on the network, with --serial at a pseudo-terminal, which any
    serial software can open (Linux and macOS). Prints the address or the port's path, then serves until interrupted
    (Ctrl-C), which is its proper end: exit code 0. Exit code 2 when there is no such language or not exactly one
    cable, 3 when the port is taken.
    """
    from drivers.pjlink.wire import MAX_PASSWORD
    from foundation.clock import SystemClock
    from foundation.errors import ConfigurationError, InputError
    from sim.projectors.projector import SimulatedProjector

    if (pjlink is None) == (serial is None):
        raise ConfigurationError("one projector has one cable: either --pjlink PORT or --serial LANGUAGE")
    if pjlink is None and (password, udp, notify) != (None, None, None):
        raise ConfigurationError("--password, --udp and --notify are PJLink's; a serial cable has none of them")
    if password is not None and not 1 <= len(password) <= MAX_PASSWORD:
        raise InputError(
            f"the password has {len(password)} characters; PJLink allows at least 1, at most {MAX_PASSWORD}"
        )
    device = SimulatedProjector(SystemClock())
    if serial is not None:
        _serve_serial(device, serial)
    elif pjlink is not None:
        _serve_network(device, pjlink, password, udp, None if notify is None else _host_and_port(notify))


def _serve_network(
    device: SimulatedProjector, pjlink: int, password: str | None, udp: int | None, controller: tuple[str, int] | None
) -> None:
    from sim.projectors.pjlink import serve_pjlink
    from sim.projectors.pjlink_notices import ProjectorDatagrams

    with ExitStack() as served:
        host, port = served.enter_context(serve_pjlink(device, pjlink, password)).address
        if udp is not None or controller is not None:
            datagrams = served.enter_context(ProjectorDatagrams(device, udp or 0, controller))
            if udp is not None:
                print(f"PJLink searches at {datagrams.address[0]}:{datagrams.address[1]}")
        _until_interrupted(f"PJLink projector at {host}:{port}")


def _serve_serial(device: SimulatedProjector, name: str) -> None:
    from drivers.serial_projectors import language
    from foundation.errors import ConfigurationError

    spoken = language(name)
    try:
        from sim.buses.pty import PseudoTerminal
    except ImportError as error:
        raise ConfigurationError("this system has no pseudo-terminals; --serial needs Linux or macOS") from error
    from sim.projectors.serial import PEERS

    with PseudoTerminal(PEERS[spoken.name](device)) as terminal:
        _until_interrupted(f"{spoken.maker} projector at {terminal.path}")


@app.command()
def camera(
    port: Annotated[int | None, typer.Option(min=0, max=65535, help="TCP port for PTP/IP; 0 picks a free one.")] = None,
    usbip: Annotated[int | None, typer.Option(min=0, max=65535, help="TCP port for USB/IP; 3240 is the usual.")] = None,
    model: Annotated[str, typer.Option(help="EOS 550D, EOS 6D Mark II, or Test: a small frame.")] = "EOS 550D",
) -> None:
    """Serve a simulated Canon EOS on a network or a USB cable: it photographs grey squares under white light.

    Reads and writes no file. Prints the address it listens on, then serves until interrupted (Ctrl-C), which is its
    proper end: exit code 0. Exit code 2 when there is no such model or not exactly one cable, 3 when the port is taken.

    With --port, any software that speaks PTP/IP can use it, for instance (both connections go to one port):

    gphoto2 --camera "PTP/IP Camera" --port ptpip:127.0.0.1:15740:15740 --capture-image-and-download

    With --usbip, a Linux machine can plug it in (as root, with the kernel's vhci-hcd) and use it as any USB camera:

    modprobe vhci-hcd; usbip --tcp-port 3240 attach -r 127.0.0.1 -b 1-1
    """
    from concurrent.futures import ThreadPoolExecutor

    from drivers.canon.apex import SHUTTER
    from drivers.presenter import WHITE
    from drivers.ptp.codes import Property
    from foundation.clock import SystemClock
    from foundation.errors import ConfigurationError
    from sim.buses.ptpip_server import serve_ptpip
    from sim.buses.usb_device import PtpUsbDevice, UsbIdentity
    from sim.buses.usbip import serve_usbip
    from sim.camera.eos import SimulatedEos
    from sim.camera.eos_bodies import EOS_BODIES
    from sim.camera.film import WorldFilm
    from sim.world.room import REFERENCE_EXPOSURE, Room
    from sim.world.sensors import BODIES
    from sim.world.world import World

    if (port is None) == (usbip is None):
        raise ConfigurationError("one camera has one cable: either --port N for PTP/IP or --usbip N for USB/IP")
    if model not in EOS_BODIES:
        raise ConfigurationError(f"--model {model!r}: known are {', '.join(sorted(EOS_BODIES))}")
    # A lamp that ages would be dark by now: its drift counts from the day when the simulated lab opened.
    world = World(_grey_squares(), BODIES[model], Room(lamp_drift_per_hour=0))
    film = WorldFilm(world, lambda: WHITE, lambda: 1.0, "0000000001", {})
    with ThreadPoolExecutor(1, "developing") as executor:
        eos = SimulatedEos(EOS_BODIES[model], film, SystemClock(), auto_power_off_s=0, executor=executor)
        eos.set_menu(Property.EOS_SHUTTER_SPEED, SHUTTER.code(REFERENCE_EXPOSURE.shutter_s))
        if port is not None:
            with serve_ptpip(eos, port, name=eos.body.model) as server:
                _until_interrupted("PTP/IP camera {} at {}:{}".format(eos.body.model, *server.address))
        elif usbip is not None:
            device = PtpUsbDevice(eos, UsbIdentity(*eos.body.usb, serial=eos.serial, name=eos.body.model))
            with serve_usbip([device], usbip) as server:
                _until_interrupted("USB/IP camera {} at {}:{}, bus id 1-1".format(eos.body.model, *server.address))


def _grey_squares() -> Print:
    """Return an A4 sheet with five by three squares from black to paper white."""
    import numpy as np

    from sim.world.drawing import Print

    column, row = (grid.ravel() for grid in np.meshgrid(np.arange(5), np.arange(3)))
    left, top = 18 + 54.0 * column, 21 + 60.0 * row
    boxes = np.stack([left, top, left + 45, top + 45], axis=-1).astype(np.float64)
    grey = np.linspace(0, 248, len(left)).round().astype(np.uint8)
    return Print((297, 210), boxes, np.stack([grey] * 3, axis=-1))


def _host_and_port(text: str) -> tuple[str, int]:
    from foundation.errors import InputError

    host, _, port = text.rpartition(":")
    if not host or not port.isascii() or not port.isdigit() or not 1 <= int(port) <= 65535:
        raise InputError(f"{text!r} is no address; expected HOST:PORT, such as 127.0.0.1:4352")
    return host, int(port)


def _until_interrupted(announcement: str) -> None:
    """Say where the device is, and serve until Ctrl-C or a request to end, also where a shell had them ignored."""
    try:
        for request in (signal.SIGINT, signal.SIGTERM):
            signal.signal(request, signal.default_int_handler)
        # Whoever reads it may interrupt at once.
        print(announcement, flush=True)
        threading.Event().wait()
    except KeyboardInterrupt:
        print("stopped")


if __name__ == "__main__":
    raise SystemExit(main())
