"""`LAB.toml`: one file to typed, frozen settings; an unknown key is an error that names the nearest known one.

Nothing here opens anything: paths are resolved against the file's folder, values are checked, that is all.
"""

from __future__ import annotations

import math
import os
import re
import shlex
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeVar, cast
from urllib.parse import urlsplit

import tomli_w
from packaging.licenses import InvalidLicenseExpression, canonicalize_license_expression
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainValidator,
    PrivateAttr,
    ValidationError,
)

from drivers.camera import ExposureSettings
from foundation.errors import ConfigurationError
from foundation.files import read_text
from foundation.records import find_mistakes, list_mistakes, parse_toml
from foundation.secret_texts import MASK, is_webhook, target_label

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]

# Keys whose values are in no message, nor in `session.toml`: a session is copied, shown and published.
_SECRETS = ("sequence.notify", "notify.alive", "lab.projector.password")

# The rig of a session of which nothing more can be taken: no one writes it into LAB.toml.
NOT_TO_CHOOSE: Final = "imported"

# A file that is named for a secret is read as far as this: passwords and addresses are shorter, and a file that is
# longer was named by mistake.
_SECRET_BYTES = 4096


def _target_checked(target: str) -> str:
    """Return the target of notices as it is: a URL with a host, or a command line; empty is nobody.

    Anything else is refused by a ValueError, whose message does not hold it.
    """
    if not is_webhook(target):
        # A quotation that does not end is refused here.
        shlex.split(target)
        return target
    parts = urlsplit(target)
    if not parts.hostname or parts.port == 0:
        raise ValueError("a URL names a host, as in https://ntfy.sh/my-lab")
    if not target.removesuffix(f"/{MASK}").isascii() or any(character.isspace() for character in target):
        raise ValueError("a URL has no spaces and no letters but ASCII's; write them as %20 and the like")
    return target


def spdx_expression(licence: str) -> str:
    """Return an SPDX licence expression in its canonical spelling, ``CC-BY-4.0``; empty stays empty.

    SPDX specification 2.3, annex D, so that programs and lawyers read the same; anything else is a ValueError.
    """
    if not licence.strip():
        return ""
    try:
        return str(canonicalize_license_expression(licence))
    except InvalidLicenseExpression as error:
        raise ValueError(
            "no SPDX licence expression; expected an identifier of spdx.org/licenses, such as CC-BY-4.0 or CC0-1.0, or "
            "LicenseRef-NAME for a licence of your own"
        ) from error


def _endless(value: object) -> object:
    """Return infinity for the word ``forever``, and a number as it is."""
    if not isinstance(value, str):
        return value
    if value.strip().lower() != "forever":
        raise ValueError('a number of seconds was expected, or "forever"')
    return math.inf


def _f_number(value: object) -> float | Literal["none"]:
    """Return an f-number as it is given, or the word ``none``."""
    if value == "none":
        return "none"
    if isinstance(value, int | float) and not isinstance(value, bool) and 0 < value < math.inf:
        return float(value)
    raise ValueError('an f-number above 0 was expected, or "none" for a lens without contacts')


def _address(host: str) -> str:
    """Return a name or an address of the network as it is; a ValueError says what something else is."""
    if host.startswith("/dev/") or re.fullmatch(r"COM\d+", host, re.IGNORECASE):
        raise ValueError("a serial port, which is given as device; an address was expected, such as 192.168.1.30")
    if "/" in host:
        raise ValueError("an address alone was expected, such as 192.168.1.30, without http:// or a path")
    if (parts := re.fullmatch(r"([^:\[\]]+):(\d+)", host)) is not None:
        raise ValueError(f'an address alone was expected: write host = "{parts[1]}" and port = {parts[2]}')
    return host


Host = Annotated[str, AfterValidator(_address)]


class Settings(BaseModel):
    """What a settings file may say: frozen, and a key that is not known is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)


_AnySettings = TypeVar("_AnySettings", bound=Settings)


class CameraSettings(Settings):
    """How every frame of the session is exposed; the exposure is fixed for a session."""

    iso: Annotated[int, Field(gt=0)] = 100
    """ISO speed."""
    aperture: Annotated[float | Literal["none"], PlainValidator(_f_number)] = 8.0
    """f-number; ``"none"`` where the body has no say in it: a lens without contacts, an adapter, a telescope."""
    shutter_s: Positive = 0.5
    """Shutter time in seconds; under a DLP projector at least 0.5 and a whole multiple of 1/60."""

    @cached_property
    def exposure(self) -> ExposureSettings:
        """The same as the camera drivers take it."""
        return ExposureSettings(self.iso, None if self.aperture == "none" else self.aperture, self.shutter_s)


class SequenceSettings(Settings):
    """How the session is taken."""

    settle_s: NotNegative = 0.5
    """Seconds between a colour's appearance on the screen and the release."""
    reference_every: Annotated[int, Field(ge=1)] = 25
    """Lights between two pairs of white and dark frames."""
    attempts: Annotated[int, Field(ge=1, le=20)] = 3
    """Tries at a frame before it is left for the next run."""
    warm_up_s: NotNegative = 1200.0
    """Seconds that the lamp burns after it was switched on before the first frame."""
    patience_s: Annotated[float, BeforeValidator(_endless), Field(ge=0)] = 600.0
    """Seconds that a run pauses for a device or the disk that fails, before it ends: camera, screen, projector, disk
    alike; ``inf`` or ``"forever"``: until it is mended. Ten minutes outlast a restart of any of them, and a run that
    ended lets the lamp go out."""
    order: Literal["shuffled", "listed"] = "shuffled"
    """Order of the lights: shuffled by `seed`, so that neither the lamp's drift nor a picture that did not change runs
    along with the colour; or as they are listed."""
    seed: Annotated[int, Field(ge=0)] = 1
    """Seed of the shuffled order."""
    switch_off: bool = True
    """Whether the projector is switched off when the session is complete."""
    lamp_if_unfinished: Literal["off", "on"] = "off"
    """What the lamp does when a run ends by itself before the session is complete: it goes out, for nobody may be
    there, or burns on, so that the next run needs no warm-up. After Ctrl-C it is left as it is."""
    relight: bool = False
    """Whether a projector that is in standby during a run, as after a power cut, is lit again; the run goes on when it
    is warm. Not unless asked for: whoever switched it off may have had a reason."""
    refused_gb: Annotated[float, Field(gt=0)] = 5.0
    """Gigabytes that refused and voided frames of one run may take of the disk before it ends: two hundred frames of an
    18-megapixel body, a quarter of a session's; ``inf``: as many as there is space for."""
    notify: Annotated[str, AfterValidator(_target_checked), Field(repr=False)] = ""
    """Who is told when a run pauses, goes on and ends: a URL that gets JSON by POST, or a command that gets the same on
    its standard input; empty: nobody. Or ``{ env = "NAME" }`` or ``{ file = "PATH" }``, where that is found. Kept out
    of messages and `session.toml`, but for the host or the program's name."""


class NotifySettings(Settings):
    """Who is told that a run lives."""

    alive: Annotated[str, AfterValidator(_target_checked), Field(repr=False)] = ""
    """A URL or a command that is told at most once a minute that the run is at work, and at its end how it ended, as
    `sequence.notify` is told; what expects that, and pages somebody when it does not come, is a dead man's switch."""


class LimitSettings(Settings):
    """When a frame is refused."""

    clipped_percent: NotNegative = 0.1
    """Largest share of photosites at or above 98 % of saturation, per cent."""
    too_dark_dn: NotNegative = 100.0
    """A lit frame's brightest photosites must reach this many counts above black."""
    stray_light_percent: NotNegative = 5.0
    """A dark frame's brightest photosites may reach this share of saturation, per cent."""


class JudgeSettings(Settings):
    """What every frame is measured for while the session is taken, and when it is refused.

    Pixels are those of the half-size picture, one for each 2×2 block of photosites. The limits are judgement where no
    measurement is named.
    """

    chart: bool = True
    """Whether the chart is looked for in the frames: false for a bare wall, of which only the light is judged."""
    response: bool = True
    """Whether a session begins with the projector's primaries and greys, by which the light of all codes is foretold:
    false saves some twenty frames, and lights are then held against less."""
    moved_px: NotNegative = 0.2
    """Largest displacement of the chart from where it lies at rest, px: in the first white frame, or where it was
    pushed to and stays, if that is less than a pixel away. Ten times the error of the measurement on a dark frame
    (0.02 at 66 counts), and below 0.3, about the margin that the 25 samples of a cell have."""
    blur_px: NotNegative = 0.3
    """Largest growth of the blur σ since the first white frame, px, as the root of the difference of the squares: less
    than a lens's own 0.5."""
    drift_percent: NotNegative = 1.0
    """Deviation of the lamp's level from the one expected after the frames before that is always allowed, per cent:
    usual for a warm lamp; `build-lut` warns at as much. Where lights scatter, more is allowed."""
    dark_percent: NotNegative = 5.0
    """Largest light in a dark frame, of white, per cent: half of what `build-lut` refuses. It warns from 0.5 on, and so
    does `acquire check`: light that is always there harms deep colours, and no frame gets better by being retaken."""
    ambient_percent: NotNegative = 0.2
    """Largest change of that light since the first dark frame, of white, per cent: `build-lut` warns at as much."""
    light_deg: NotNegative = 0.5
    """Angle between the light seen and the one ordered, as predicted from the response frames, that is always allowed,
    degrees; where the prediction is uncertain, more is. A quarter of the 2 degrees within which a fifth of the 707 have
    their neighbour."""


class CitationSettings(Settings):
    """What a table says of itself that no device tells; `build-lut` writes it into the table and its data sets."""

    title: Annotated[str, Field(max_length=500)] = ""
    """What the table is called where it is cited; empty: its camera and lights."""
    authors: tuple[Annotated[str, Field(min_length=1, max_length=200)], ...] = ()
    """Who made it, each as "Family, Given" or the name of an institution."""
    licence: Annotated[str, Field(max_length=500), AfterValidator(spdx_expression)] = ""
    """Under which licence the table may be used, an SPDX expression such as "CC-BY-4.0"; empty: not recorded."""
    note: Annotated[str, Field(max_length=20_000)] = ""
    """What whoever took the session wants readers to know: what was ordered at the print shop, what went wrong."""
    url: Annotated[str, Field(max_length=500)] = ""
    """Where the table is found, its DOI for example."""
    lens: Annotated[str, Field(max_length=500)] = ""
    """The lens, where it has no contacts, so that raw files do not name it."""
    projector: Annotated[str, Field(max_length=500)] = ""
    """The projector, where it has no control port that names it."""
    camera_serial: Literal["hash", "plain", "withheld"] = "hash"
    """How the body's serial number is told in the table: its hash tells bodies apart and no more, "plain" is the number
    itself, "withheld" nothing."""


class SimulatedSettings(Settings):
    """The simulated lab."""

    body: str = "EOS 550D"
    """Camera body in it: EOS 550D, EOS 6D Mark II, Test; or sensitivities by name or file, as `sim table --camera`."""
    camera: dict[str, Any] | None = None
    """Facts of the body that differ, by the names of sim.world.sensors.Body."""
    seed: Annotated[int, Field(ge=0)] = 1
    """Seed of everything that chance decides: paper, noise."""
    room: dict[str, bool | int | float | str] = {}
    """Physical parameters of the room that differ from the default; see sim.world.world.Room."""
    events: tuple[dict[str, Any], ...] = ()
    """What goes wrong, by frame or time; see sim.world.disturbances. May change within a session, as luck does."""


class CameraCable(Settings):
    """Where the camera of a real lab is found."""

    connection: Literal["usb", "ptpip", "gphoto2"] = "usb"
    """Canon EOS on USB, Canon EOS on the network (PTP/IP), or any body through libgphoto2."""
    serial: str | None = None
    """USB: serial number of the body, where several hang on the machine."""
    usb_port: str | None = None
    """USB: the port it is plugged into, such as 1-2.4, for bodies without a serial number on USB."""
    host: Host | None = None
    """PTP/IP: address of the camera."""
    port: Annotated[int, Field(ge=1, le=65535)] = 15740
    """PTP/IP: TCP port."""
    event_port: Annotated[int, Field(ge=1, le=65535)] | None = None
    """PTP/IP: TCP port of the event connection where it is another."""
    gphoto2_port: str | None = None
    """libgphoto2's name of the port; the first camera found if left out."""
    gphoto2_model: str | None = None
    """libgphoto2's name of the model; found out if left out."""


class ProjectorCable(Settings):
    """How the projector of a real lab is controlled, and what its light is like."""

    control: Literal["none", "pjlink", "serial"] = "none"
    """PJLink, or the maker's language over a serial port or TCP; none: someone switches it by hand."""
    language: str | None = None
    """With ``serial``: name of a language (docs/devices.md), or path of a language file (.toml), relative to the
    settings file."""
    host: Host | None = None
    """Address, for PJLink and for languages over TCP."""
    port: Annotated[int, Field(ge=1, le=65535)] | None = None
    """TCP port where it is not the language's own."""
    password: Annotated[str | None, Field(repr=False)] = None
    """PJLink password, or ``{ env = "NAME" }`` or ``{ file = "PATH" }``, where it is found; not in `session.toml`."""
    device: str | None = None
    """Serial port, such as /dev/ttyUSB0."""
    baud: Annotated[int, Field(ge=300)] | None = None
    """Baud rate where it is not the language's own."""
    refresh_hz: Positive = 60.0
    """Pictures that it shows a second."""
    colour_wheel_hz: NotNegative = 60.0
    """Turns of its colour wheel a second; 0: it has none (LCD, LCoS, LED)."""


class LightSource(Settings):
    """The display of this machine that the projector shows."""

    display: str | int | None = None
    """Name, position or number of the display; acquire devices lists them."""


class LabRig(Settings):
    """The cables of a real lab."""

    camera: CameraCable = CameraCable()
    projector: ProjectorCable = ProjectorCable()
    light: LightSource = LightSource()


class LabSettings(Settings):
    """Everything that LAB.toml says."""

    rig: Literal["lab", "simulated", "imported"]
    """What stands at the end of the cables: real devices or the simulated lab; `imported` marks a session whose frames
    were taken by other means."""
    chart: Path
    """chart.json of the print, relative to the settings file."""
    illuminations: Path
    """illuminations.csv of the plan, relative to the settings file."""
    camera: CameraSettings = CameraSettings()
    sequence: SequenceSettings = SequenceSettings()
    notify: NotifySettings = NotifySettings()
    limits: LimitSettings = LimitSettings()
    judge: JudgeSettings = JudgeSettings()
    simulated: SimulatedSettings = SimulatedSettings()
    citation: CitationSettings = CitationSettings()
    lab: LabRig = LabRig()
    _file: str = PrivateAttr(default="LAB.toml")

    @property
    def file(self) -> str:
        """The file that the settings were read from, for messages."""
        return self._file

    def read_from(self, file: str) -> LabSettings:
        """Return the same settings as read from a file."""
        named = self.model_copy()
        named._file = file  # noqa: SLF001 - its own class
        return named

    def to_toml(self) -> str:
        """Return the settings, defaults included, as the text of `session.toml`; secrets are masked."""
        values = self.model_dump(mode="json", exclude_none=True)
        values["sequence"]["notify"] = target_label(self.sequence.notify)
        values["notify"]["alive"] = target_label(self.notify.alive)
        # A password is needed to take frames, and whoever does that has LAB.toml.
        values["lab"]["projector"].pop("password", None)
        return tomli_w.dumps(values)


def load_lab(path: Path) -> LabSettings:
    """Read `LAB.toml`, every path resolved against its folder; a ConfigurationError names what cannot be used."""
    if path.is_dir():
        remedy = f"name {path / 'LAB.toml'}"
        raise ConfigurationError("a folder, a file of settings was expected", about=path, remedy=remedy)
    folder = path.resolve().parent
    settings = parse_lab(
        read_text(path, "acquire init writes one to begin with; it comes before the session", "settings"),
        str(path),
        folder,
    )
    changes: dict[str, Any] = {"chart": folder / settings.chart, "illuminations": folder / settings.illuminations}
    language = settings.lab.projector.language
    if language is not None and language.lower().endswith(".toml"):
        projector = settings.lab.projector.model_copy(update={"language": str(folder / language)})
        changes["lab"] = settings.lab.model_copy(update={"projector": projector})
    return settings.model_copy(update=changes)


def parse_lab(text: str, where: str, folder: Path | None = None) -> LabSettings:
    """Return the settings in a TOML text, paths as they stand there; a ConfigurationError names what cannot be used.

    `where`: names them in errors. `folder`: what files that hold secrets are relative to; None where secrets are not
    looked up: in a session's own settings there are none.
    """
    document = parse_toml(text, where)
    if folder is not None:
        _look_up_secrets(document, folder, where)
    return checked(LabSettings, document, where).read_from(where)


def checked(kind: type[_AnySettings], document: dict[str, Any], where: str) -> _AnySettings:
    """Return the settings in a document; a ConfigurationError names every key that cannot be used, no secret."""
    try:
        return kind.model_validate(document)
    except ValidationError as error:
        found = find_mistakes(kind, document, error, _is_secret, NOT_TO_CHOOSE)
        # The cause has the values, too.
        secret = any(_is_secret(".".join(map(str, one["loc"]))) for one in error.errors())
        raise ConfigurationError(f"{where}:{list_mistakes(found)}") from (None if secret else error)


def _is_secret(key: str) -> bool:
    """Return whether the value of a key holds a secret: what is above one does, and so does what is below it."""
    return any(f"{known}.".startswith(f"{key}.") or key.startswith(f"{known}.") for known in _SECRETS)


def _look_up_secrets(document: dict[str, Any], folder: Path, where: str) -> None:
    """Put the secrets in the place of what says where they are found.

    A password of devices that this rig does not have is left out: nobody has to know it to rehearse a session.
    """
    missing: list[ConfigurationError] = []
    for key in _SECRETS:
        *tables, last = key.split(".")
        holder: Any = document
        for name in tables:
            holder = cast("dict[str, Any]", holder).get(name) if isinstance(holder, dict) else None
        table = cast("dict[str, Any]", holder) if isinstance(holder, dict) else {}
        found = table.get(last)
        if isinstance(found, dict):
            place = cast("dict[str, Any]", found)
            if tables[0] == "lab" and document.get("rig") != "lab":
                del table[last]
                continue
            try:
                table[last] = _found_secret(key, place, folder)
            except ConfigurationError as error:
                missing.append(error)
    if missing:
        raise ConfigurationError(f"{where}:{list_mistakes([str(one) for one in missing])}") from missing[0]


def _found_secret(key: str, place: dict[str, Any], folder: Path) -> str:
    match place:
        case {"env": str(name), **more} if not more:
            secret = os.environ.get(name, "")
            if not secret:
                raise ConfigurationError(
                    f"{key}: the environment has no {name}; set it for this command, as in: "
                    f"read -rs {name} && export {name}"
                )
        case {"file": str(name), **more} if not more:
            path = folder / name
            try:
                # Neither a device nor a pipe: these never end.
                if path.exists() and not path.is_file():
                    raise ConfigurationError(f"{key}: {path} is no file; name one that holds the secret alone")
                with path.open(encoding="utf-8-sig") as stream:
                    secret = stream.read(_SECRET_BYTES).partition("\n")[0].strip()
            except (OSError, UnicodeDecodeError, ValueError) as error:
                reason = (error.strerror if isinstance(error, OSError) else None) or "it is no text"
                raise ConfigurationError(f"{key}: cannot read {path}: {reason}; name a readable file") from error
            if not secret:
                raise ConfigurationError(f"{key}: the first line of {path} is empty; write the secret there")
        case _:
            raise ConfigurationError(
                f'{key}: expected the text itself, {{ env = "NAME" }} or {{ file = "PATH" }}, and nothing beside'
            )
    return secret
