"""Settings of `LAB.toml`: typed, frozen and checked; an unknown key is an error that names the closest known key.

No device is opened here. Paths are resolved against the folder of the file, and values are checked.
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

# Keys whose values must not appear in messages or in `session.toml`, because sessions are copied and published.
_SECRETS = ("sequence.notify", "notify.alive", "lab.projector.password")

# Rig of a session with imported frames, in which no more frames can be taken. Messages do not offer it for LAB.toml.
NOT_TO_CHOOSE: Final = "imported"

# Characters read from a file with a secret: passwords and addresses are shorter. A longer file was given by mistake.
_SECRET_CHARACTERS = 4096


# A target of notices is a URL with a host, or a command line. No message contains it, because it may hold a secret.
def _check_target(target: str) -> str:
    if not is_webhook(target):
        # Raises ValueError for an unclosed quotation mark.
        shlex.split(target)
        return target
    url = urlsplit(target)
    if not url.hostname or url.port == 0:
        raise ValueError("the URL has no host, expected a URL such as https://ntfy.sh/my-lab")
    if not target.removesuffix(f"/{MASK}").isascii() or any(character.isspace() for character in target):
        raise ValueError("the URL has spaces or non-ASCII letters, expected %20 and similar instead")
    return target


def spdx_expression(licence: str) -> str:
    """Return an SPDX licence expression in canonical spelling, ``CC-BY-4.0``; an empty text stays empty.

    SPDX specification 2.3, annex D. Other texts raise a ValueError.
    """
    if not licence.strip():
        return ""
    try:
        return str(canonicalize_license_expression(licence))
    except InvalidLicenseExpression as error:
        raise ValueError(
            "not an SPDX licence expression, expected an identifier of spdx.org/licenses, such as CC-BY-4.0 or "
            "CC0-1.0, or LicenseRef-NAME for your own licence"
        ) from error


def _parse_seconds(value: object) -> object:
    if not isinstance(value, str):
        return value
    if value.strip().lower() != "forever":
        raise ValueError('expected a number of seconds, or "forever"')
    return math.inf


def _parse_f_number(value: object) -> float | Literal["none"]:
    if value == "none":
        return "none"
    if isinstance(value, int | float) and not isinstance(value, bool) and 0 < value < math.inf:
        return float(value)
    raise ValueError('expected an f-number above 0, or "none" for a lens without contacts')


def _check_host(host: str) -> str:
    if host.startswith("/dev/") or re.fullmatch(r"COM\d+", host, re.IGNORECASE):
        raise ValueError("a serial port, expected an address such as 192.168.1.30; give the port as device instead")
    if "/" in host:
        raise ValueError("expected only an address, such as 192.168.1.30, without http:// or a path")
    if (match := re.fullmatch(r"([^:\[\]]+):(\d+)", host)) is not None:
        raise ValueError(f'expected only an address; write host = "{match[1]}" and port = {match[2]}')
    return host


Host = Annotated[str, AfterValidator(_check_host)]


class Settings(BaseModel):
    """Base of settings tables: frozen, and unknown keys are errors."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)


_AnySettings = TypeVar("_AnySettings", bound=Settings)


class CameraSettings(Settings):
    """Exposure of every frame; it is constant in a session."""

    iso: Annotated[int, Field(gt=0)] = 100
    """ISO speed."""
    aperture: Annotated[float | Literal["none"], PlainValidator(_parse_f_number)] = 8.0
    """f-number; ``"none"`` if the body does not control the aperture: lens without contacts, adapter, telescope."""
    shutter_s: Positive = 0.5
    """Shutter time in seconds; under a DLP projector at least 0.5 and a whole multiple of 1/60."""

    @cached_property
    def exposure(self) -> ExposureSettings:
        """The settings in the form that camera drivers use."""
        return ExposureSettings(self.iso, None if self.aperture == "none" else self.aperture, self.shutter_s)


class SequenceSettings(Settings):
    """How the session is taken."""

    settle_s: NotNegative = 0.5
    """Seconds between the appearance of a colour on the screen and the release."""
    reference_every: Annotated[int, Field(ge=1)] = 25
    """Number of illuminants between two pairs of white and dark frames."""
    attempts: Annotated[int, Field(ge=1, le=20)] = 3
    """Attempts at a frame before it is left to the next run."""
    warm_up_s: NotNegative = 1200.0
    """Seconds that the lamp warms up before the first frame."""
    patience_s: Annotated[float, BeforeValidator(_parse_seconds), Field(ge=0)] = 600.0
    """Seconds that a run waits for a device (camera, screen, projector) or the disk after a failure, before it ends;
    ``inf`` or ``"forever"``: no limit. Each of them restarts within ten minutes. When a run ends, the lamp goes out."""
    order: Literal["shuffled", "listed"] = "shuffled"
    """Order of the illuminants: shuffled by `seed`, so that drift of the lamp and unchanged images do not correlate
    with colour; or as listed."""
    seed: Annotated[int, Field(ge=0)] = 1
    """Seed of the shuffled order."""
    switch_off: bool = True
    """Switch the projector off when the session is complete."""
    lamp_if_unfinished: Literal["off", "on"] = "off"
    """State of the lamp when a run ends with an incomplete session: off, because nobody may be present, or on, so that
    the next run needs no warm-up. Ctrl-C does not change it."""
    relight: bool = False
    """Switch a projector on again that is in standby during a run, for example after a power cut; the run continues
    when the lamp is warm. Off by default, because somebody may have switched the projector off on purpose."""
    refused_gb: Annotated[float, Field(gt=0)] = 5.0
    """Disk space in gigabytes for refused and void frames of one run, after which it ends: 200 frames of 18 megapixels,
    a quarter of a session; ``inf``: no limit."""
    notify: Annotated[str, AfterValidator(_check_target), Field(repr=False)] = ""
    """Receiver of notices when a run pauses, resumes and ends: a URL that gets JSON by POST, or a command that gets
    it on its standard input; empty: none. ``{ env = "NAME" }`` or ``{ file = "PATH" }`` read it from an environment
    variable or a file. Messages and `session.toml` contain only the host or the name of the program."""


class NotifySettings(Settings):
    """Signs of life of a run."""

    alive: Annotated[str, AfterValidator(_check_target), Field(repr=False)] = ""
    """A URL or a command, as in `sequence.notify`, that gets a sign of life of the run at most once a minute, and its
    result at the end. A service that expects it and alerts somebody if it is missing is a dead man's switch."""


class LimitSettings(Settings):
    """Limits of exposure beyond which a frame is refused."""

    clipped_percent: NotNegative = 0.1
    """Largest fraction of photosites at or above 98 % of saturation, per cent."""
    too_dark_dn: NotNegative = 100.0
    """Smallest level of the brightest photosites of a lit frame, counts above black."""
    stray_light_percent: NotNegative = 5.0
    """Largest level of the brightest photosites of a dark frame, per cent of saturation."""


class JudgeSettings(Settings):
    """Limits of the measurements of every frame, beyond which it is refused.

    Pixels are half-size pixels, one for each 2×2 block of photosites. Limits without a measurement are judgement.
    """

    chart: bool = True
    """Detect the chart in the frames; false for a bare wall, of which only the light is judged."""
    response: bool = True
    """Start a session with primaries and greys of the projector, from which the light of all codes is predicted; false
    saves about 20 frames, but illuminants are then checked less."""
    moved_px: NotNegative = 0.2
    """Largest displacement of the chart from its rest position, px. That is the position in the first white frame, or a
    later one less than a pixel away at which it stays. The limit is ten times the error on a dark frame (0.02 px at
    66 counts), and below the margin of the 25 samples of a patch (about 0.3 px)."""
    blur_px: NotNegative = 0.3
    """Largest growth of the blur σ since the first white frame, px, as root of the difference of squares: less than the
    blur of a lens (0.5 px)."""
    drift_percent: NotNegative = 1.0
    """Deviation of the lamp from its expected level that is always allowed, per cent: usual for a warm lamp;
    `build-lut` warns from the same value. If levels scatter, more is allowed."""
    dark_percent: NotNegative = 5.0
    """Largest light in a dark frame, per cent of white: half of the limit of `build-lut`, which warns from 0.5 %, as
    does `acquire check`. Constant stray light harms dark colours, and repeating a frame does not remove it."""
    ambient_percent: NotNegative = 0.2
    """Largest change of that light since the first dark frame, per cent of white: `build-lut` warns from the same
    value."""
    light_deg: NotNegative = 0.5
    """Angle between the measured and the predicted illuminant that is always allowed, degrees; if the prediction is
    uncertain, more is allowed. The prediction uses the response frames. A fifth of the 707 illuminants have a neighbour
    within 2 degrees, four times this value."""


class CitationSettings(Settings):
    """Information that no device provides; `build-lut` writes it into the look-up table (LUT) and its data sets."""

    title: Annotated[str, Field(max_length=500)] = ""
    """Title of the LUT in citations; empty: its camera and illuminants."""
    authors: tuple[Annotated[str, Field(min_length=1, max_length=200)], ...] = ()
    """Authors, each as "Family, Given" or the name of an institution."""
    licence: Annotated[str, Field(max_length=500), AfterValidator(spdx_expression)] = ""
    """Licence of the LUT, an SPDX expression such as "CC-BY-4.0"; empty: not recorded."""
    note: Annotated[str, Field(max_length=20_000)] = ""
    """Note for readers of the LUT, for example the order at the print shop, or what went wrong."""
    url: Annotated[str, Field(max_length=500)] = ""
    """Address of the LUT, for example its DOI."""
    lens: Annotated[str, Field(max_length=500)] = ""
    """The lens, if it has no contacts and raw files do not name it."""
    projector: Annotated[str, Field(max_length=500)] = ""
    """The projector, if it has no control port that names it."""
    camera_serial: Literal["hash", "plain", "withheld"] = "hash"
    """Serial number of the body in the LUT: "hash" only distinguishes bodies, "plain" is the number itself, "withheld"
    leaves it out."""


class SimulatedSettings(Settings):
    """The simulated laboratory."""

    body: str = "EOS 550D"
    """Camera body: EOS 550D, EOS 6D Mark II, Test; or sensitivities by name or file, as in `sim table --camera`."""
    camera: dict[str, Any] | None = None
    """Properties of the body that differ, with the names of sim.world.sensors.Body."""
    seed: Annotated[int, Field(ge=0)] = 1
    """Seed of all random numbers: paper, noise."""
    room: dict[str, bool | int | float | str] = {}
    """Physical parameters of the room that differ from the default; see sim.world.world.Room."""
    events: tuple[dict[str, Any], ...] = ()
    """Disturbances by frame or time; see sim.world.disturbances. They may change within a session."""


class CameraCable(Settings):
    """Connection of the camera of a real laboratory."""

    connection: Literal["usb", "ptpip", "gphoto2"] = "usb"
    """usb: Canon EOS on USB; ptpip: Canon EOS on the network (PTP/IP); gphoto2: any body through libgphoto2."""
    serial: str | None = None
    """USB: serial number of the body, if several are connected."""
    usb_port: str | None = None
    """USB: port of the body, such as 1-2.4, for bodies without a serial number on USB."""
    host: Host | None = None
    """PTP/IP: address of the camera."""
    port: Annotated[int, Field(ge=1, le=65535)] = 15740
    """PTP/IP: TCP port."""
    event_port: Annotated[int, Field(ge=1, le=65535)] | None = None
    """PTP/IP: TCP port of the event connection, if different."""
    gphoto2_port: str | None = None
    """Name of the port in libgphoto2; by default the first detected camera."""
    gphoto2_model: str | None = None
    """Name of the model in libgphoto2; detected by default."""


class ProjectorCable(Settings):
    """Control and light of the projector of a real laboratory."""

    control: Literal["none", "pjlink", "serial"] = "none"
    """pjlink: PJLink; serial: language of the manufacturer over a serial port or TCP; none: switched by hand."""
    language: str | None = None
    """For ``serial``: name of a language (docs/devices.md), or path of a language file (.toml), relative to the
    settings file."""
    host: Host | None = None
    """Address, for PJLink and for languages over TCP."""
    port: Annotated[int, Field(ge=1, le=65535)] | None = None
    """TCP port, if different from the default of the language."""
    password: Annotated[str | None, Field(repr=False)] = None
    """PJLink password. ``{ env = "NAME" }`` or ``{ file = "PATH" }`` read it from an environment variable or a file. It
    is not in `session.toml`."""
    device: str | None = None
    """Serial port, such as /dev/ttyUSB0."""
    baud: Annotated[int, Field(ge=300)] | None = None
    """Baud rate, if different from the default of the language."""
    refresh_hz: Positive = 60.0
    """Images per second."""
    colour_wheel_hz: NotNegative = 60.0
    """Turns of the colour wheel per second; 0: none (LCD, LCoS, LED)."""


class LightSource(Settings):
    """The display of this computer that is connected to the projector."""

    display: str | int | None = None
    """Name, position or number of the display; `acquire devices` lists them."""


class LabRig(Settings):
    """Connections of a real laboratory."""

    camera: CameraCable = CameraCable()
    projector: ProjectorCable = ProjectorCable()
    light: LightSource = LightSource()


class LabSettings(Settings):
    """All settings of LAB.toml."""

    rig: Literal["lab", "simulated", "imported"]
    """Devices: lab (real devices) or simulated (simulated laboratory). `imported` marks a session with frames
    that were taken by other means."""
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
        """File of the settings, for messages."""
        return self._file

    def read_from(self, file: str) -> LabSettings:
        """Return a copy of the settings with the name of their file."""
        copy = self.model_copy()
        copy._file = file  # noqa: SLF001 - same class
        return copy

    def to_toml(self) -> str:
        """Return the settings with defaults as the text of `session.toml`; secrets are masked."""
        values = self.model_dump(mode="json", exclude_none=True)
        values["sequence"]["notify"] = target_label(self.sequence.notify)
        values["notify"]["alive"] = target_label(self.notify.alive)
        # Commands that need the password read it from LAB.toml.
        values["lab"]["projector"].pop("password", None)
        return tomli_w.dumps(values)


def load_lab(path: Path) -> LabSettings:
    """Read `LAB.toml` and resolve every path against its folder; `ConfigurationError` if a value is not usable."""
    if path.is_dir():
        remedy = f"give {path / 'LAB.toml'}"
        raise ConfigurationError("a folder, expected a settings file", about=path, remedy=remedy)
    folder = path.resolve().parent
    settings = parse_lab(
        read_text(path, "acquire init writes a first one; give it before the session", "settings"),
        str(path),
        folder,
    )
    changes: dict[str, Any] = {"chart": folder / settings.chart, "illuminations": folder / settings.illuminations}
    language = settings.lab.projector.language
    if language is not None and language.lower().endswith(".toml"):
        projector = settings.lab.projector.model_copy(update={"language": str(folder / language)})
        changes["lab"] = settings.lab.model_copy(update={"projector": projector})
    return settings.model_copy(update=changes)


def parse_lab(text: str, source_name: str, folder: Path | None = None) -> LabSettings:
    """Parse the settings in a TOML text without resolving paths; `ConfigurationError` if a value is not usable.

    Parameters
    ----------
    text
        TOML text.
    source_name
        Name of the text in errors.
    folder
        Folder to which files with secrets are relative; if None, secrets are not read, as in `session.toml`.
    """
    document = parse_toml(text, source_name)
    if folder is not None:
        _insert_secrets(document, folder, source_name)
    return validate_settings(LabSettings, document, source_name).read_from(source_name)


def validate_settings(model: type[_AnySettings], document: dict[str, Any], source_name: str) -> _AnySettings:
    """Validate the settings in a document; `ConfigurationError` lists every unusable key without secrets."""
    try:
        return model.model_validate(document)
    except ValidationError as error:
        mistakes = find_mistakes(model, document, error, _is_secret, NOT_TO_CHOOSE)
        # The cause would show the secret in the traceback.
        has_secret = any(_is_secret(".".join(map(str, mistake["loc"]))) for mistake in error.errors())
        raise ConfigurationError(f"{source_name}:{list_mistakes(mistakes)}") from (None if has_secret else error)


def _is_secret(key: str) -> bool:
    # Tables above a secret contain it, too.
    return any(f"{secret_key}.".startswith(f"{key}.") or key.startswith(f"{secret_key}.") for secret_key in _SECRETS)


def _insert_secrets(document: dict[str, Any], folder: Path, source_name: str) -> None:
    errors: list[ConfigurationError] = []
    for key in _SECRETS:
        *tables, name = key.split(".")
        holder: Any = document
        for table_name in tables:
            holder = cast("dict[str, Any]", holder).get(table_name) if isinstance(holder, dict) else None
        table = cast("dict[str, Any]", holder) if isinstance(holder, dict) else {}
        value = table.get(name)
        if isinstance(value, dict):
            source = cast("dict[str, Any]", value)
            if tables[0] == "lab" and document.get("rig") != "lab":
                # Only real devices need a password, so a session can be rehearsed without it.
                del table[name]
                continue
            try:
                table[name] = _read_secret(key, source, folder)
            except ConfigurationError as error:
                errors.append(error)
    if errors:
        raise ConfigurationError(f"{source_name}:{list_mistakes([str(mistake) for mistake in errors])}") from errors[0]


def _read_secret(key: str, source: dict[str, Any], folder: Path) -> str:
    match source:
        case {"env": str(name), **rest} if not rest:
            secret = os.environ.get(name, "")
            if not secret:
                raise ConfigurationError(
                    f"{key}: the environment variable {name} is not set; set it for this command: "
                    f"read -rs {name} && export {name}"
                )
        case {"file": str(name), **rest} if not rest:
            path = folder / name
            try:
                # Reading a device or a pipe might never end.
                if path.exists() and not path.is_file():
                    raise ConfigurationError(f"{key}: {path} is not a file; give a file with only the secret")
                with path.open(encoding="utf-8-sig") as stream:
                    secret = stream.read(_SECRET_CHARACTERS).partition("\n")[0].strip()
            except (OSError, UnicodeDecodeError, ValueError) as error:
                reason = (error.strerror if isinstance(error, OSError) else None) or "it is not text in UTF-8"
                raise ConfigurationError(f"{key}: cannot read {path}: {reason}; give a readable file") from error
            if not secret:
                raise ConfigurationError(f"{key}: the first line of {path} is empty; write the secret there")
        case _:
            raise ConfigurationError(f'{key}: expected only the text itself, {{ env = "NAME" }} or {{ file = "PATH" }}')
    return secret
