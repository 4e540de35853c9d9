"""Projectors on a serial cable: which languages are spoken, and how fast.

Each maker has a file of its own: a wire, which is pure functions of bytes for both ends, and a driver that keeps the
contract of `drivers.projector.Projector`. What a language cannot express is stated in the driver's docstring.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Protocol

from drivers.links.link import Link
from drivers.projector import Projector
from drivers.serial_projectors import benq, epson, nec, optoma
from drivers.serial_projectors.exchange import DEFAULT_TIMEOUT_S, SYSTEM_CLOCK
from foundation.clock import Clock
from foundation.errors import ConfigurationError


class ProjectorFactory(Protocol):
    """Makes a projector's driver; nothing is opened before it is first used."""

    def __call__(
        self,
        connect: Callable[[], Link],
        timeout: float = DEFAULT_TIMEOUT_S,
        label: str = "the projector",
        clock: Clock = SYSTEM_CLOCK,
    ) -> Projector:
        """Return the driver of a projector to which `connect` opens cables."""
        ...


@dataclass(frozen=True)
class Language:
    """How a maker's projectors are spoken to; `baud` and `parity` as they leave the factory.

    `network` is the driver for the same text over TCP, at `tcp_port`; None where the maker has no such thing.
    """

    name: str
    maker: str
    baud: int
    parity: str
    projector: ProjectorFactory
    tcp_port: int = 0
    network: ProjectorFactory | None = None


LANGUAGES: Mapping[str, Language] = {
    language.name: language
    for language in (
        Language("benq", "BenQ", benq.BAUD, "N", benq.BenqProjector, benq.TCP_PORT, benq.BenqProjector),
        Language(
            "epson",
            "Epson",
            epson.BAUD,
            "N",
            epson.EpsonProjector,
            epson.TCP_PORT,
            partial(epson.EpsonProjector, network=True),
        ),
        Language("nec", "NEC", nec.BAUD, "N", nec.NecProjector, nec.TCP_PORT, nec.NecProjector),
        Language("optoma", "Optoma", optoma.BAUD, "N", optoma.OptomaProjector),
    )
}


def language(name: str) -> Language:
    """Return the language called `name`, in any case."""
    try:
        return LANGUAGES[name.lower()]
    except KeyError:
        raise ConfigurationError(
            f"no projector language {name!r}; known are {', '.join(LANGUAGES)}; PJLink goes over the network"
        ) from None
