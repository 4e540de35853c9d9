"""Projectors on a serial cable: which languages are spoken, and how fast.

Each maker has a file of its own: a wire, which is pure functions of bytes for both ends, and a
`drivers.serial_projectors.driver.SerialProjector` that knows its words. What a language cannot express is stated in
that file's docstring.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from drivers.serial_projectors import benq, epson, optoma
from drivers.serial_projectors.driver import SerialProjector
from foundation.errors import ConfigurationError


@dataclass(frozen=True)
class Language:
    """How a maker's projectors are spoken to; `baud` as they leave the factory.

    `network` is the driver for the same text over TCP, at `tcp_port`; None where the maker has no such thing.
    """

    name: str
    baud: int
    projector: type[SerialProjector]
    tcp_port: int = 0
    network: type[SerialProjector] | None = None

    @property
    def maker(self) -> str:
        """The maker, as messages call it."""
        return self.projector.maker


LANGUAGES: Mapping[str, Language] = {
    language.name: language
    for language in (
        Language("benq", benq.BAUD, benq.BenqProjector, benq.TCP_PORT, benq.BenqProjector),
        Language("epson", epson.BAUD, epson.EpsonProjector, epson.TCP_PORT, epson.EpsonOnNetwork),
        Language("optoma", optoma.BAUD, optoma.OptomaProjector),
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
