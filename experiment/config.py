"""Read the settings in `LAB.toml` and check every value.

An unknown key is an error, and its message suggests the closest known key. Relative paths are resolved against the
folder of the file.
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

# Value of `rig` in a session with imported frames. Messages do not suggest it, because no frames can be taken with it.
IMPORTED_RIG: Final = "imported"

# Largest number of characters that are read from a file with a secret. Passwords and URLs are shorter.
_SECRET_CHARACTERS = 4096


# Notices are sent to a URL or to a command. Messages do not show this target, because it may contain a secret.
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
    """Return a licence expression in canonical spelling, for example ``CC-BY-4.0`` (SPDX 2.3, annex D).

    An empty text stays empty. Any other text that is not an SPDX expression raises a `ValueError`.
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
    """f-number; ``"none"`` if the camera cannot set the aperture, for example on a telescope."""
    shutter_s: Positive = 0.5
    """Shutter time in seconds. With a DLP projector, use at least 0.5 s and a whole multiple of 1/60 s."""

    @cached_property
    def exposure(self) -> ExposureSettings:
        """The settings in the form that camera drivers use."""
        return ExposureSettings(self.iso, None if self.aperture == "none" else self.aperture, self.shutter_s)


class SequenceSettings(Settings):
    """Order, timing and repetition of the frames of a session, and reactions to failures."""

    settle_s: NotNegative = 0.5
    """Waiting time between a new colour on the screen and the exposure, seconds."""
    reference_every: Annotated[int, Field(ge=1)] = 25
    """Number of illuminants between two pairs of white and dark frames."""
    attempts: Annotated[int, Field(ge=1, le=20)] = 3
    """Largest number of attempts at a frame in one run. The next run tries the frame again."""
    warm_up_s: NotNegative = 1200.0
    """Warm-up time of the lamp before the first frame, seconds."""
    patience_s: Annotated[float, BeforeValidator(_parse_seconds), Field(ge=0)] = 600.0
    """Longest time that a run waits after a failure of a device or the disk, seconds. After this time, the run ends.
    ``inf`` or ``"forever"``: no limit. Most devices restart within ten minutes."""
    order: Literal["shuffled", "listed"] = "shuffled"
    """Order of the illuminants. ``"shuffled"``: a random order from `seed`, so that lamp drift does not correlate with
    colour. ``"listed"``: the order of the file."""
    seed: Annotated[int, Field(ge=0)] = 1
    """Seed of the shuffled order."""
    switch_off: bool = True
    """Switch the projector off when the session is complete."""
    lamp_if_unfinished: Literal["off", "on"] = "off"
    """State of the lamp after a run that ends with an incomplete session. If it is on, the next run needs no warm-up.
    Ctrl-C leaves the lamp as it is."""
    relight: bool = False
    """Switch the projector on again if it goes to standby during a run, for example after a power cut. The run
    continues after the warm-up. Off by default, because somebody may have switched the projector off on purpose."""
    refused_gb: Annotated[float, Field(gt=0)] = 5.0
    """Largest disk space for the unused frames of one run, gigabytes; ``inf``: no limit. If these frames need more, the
    run ends. Frames are unused if they were refused, or accepted first and contradicted later."""
    notify: Annotated[str, AfterValidator(_check_target), Field(repr=False)] = ""
    """Target of notices when a run pauses, resumes or ends: a URL that receives JSON by POST, or a command that
    receives JSON on its standard input. If empty, no notices are sent. ``{ env = "NAME" }`` or ``{ file = "PATH" }``
    read the target from an environment variable or a file. Messages and `session.toml` contain only the host or the
    name of the program."""


class NotifySettings(Settings):
    """Regular signs of life of a run."""

    alive: Annotated[str, AfterValidator(_check_target), Field(repr=False)] = ""
    """Target of signs of life: a URL or a command, as in `sequence.notify`. A sign is sent at most once a minute, and
    the result at the end of the run. A monitoring service can alert somebody if the signs stop."""


class LimitSettings(Settings):
    """Limits of the exposure of a frame. A frame beyond a limit is refused."""

    clipped_percent: NotNegative = 0.1
    """Largest fraction of photosites at or above 98 % of saturation, per cent."""
    too_dark_dn: NotNegative = 100.0
    """Smallest level of the brightest photosites of a lit frame, counts above black."""
    stray_light_percent: NotNegative = 5.0
    """Largest level of the brightest photosites of a dark frame, per cent of saturation."""


class JudgeSettings(Settings):
    """Limits of the measurements on every frame. A frame beyond a limit is refused.

    Lengths are in half-size pixels (px), one for each 2×2 block of photosites.
    """

    chart: bool = True
    """Detect the chart in the frames. Use false for a bare wall: then only the light is checked."""
    response: bool = True
    """Start a session with response frames (primaries and greys), from which the light of all codes is predicted. With
    false, a session has about 20 frames fewer, but wrong illuminants are detected less reliably."""
    moved_px: NotNegative = 0.2
    """Largest displacement of the chart from its reference position, px. The reference is the position in the first
    white frame. If the chart is displaced slightly and then rests, its new position becomes the reference. The default
    is ten times the measurement error in a dark image."""
    blur_px: NotNegative = 0.3
    """Largest growth of the blur since the first white frame, px: √(σ² − σ₀²), with the blur σ₀ of this white frame and
    the blur σ of a later frame. The blur of a good lens is about 0.5 px."""
    drift_percent: NotNegative = 1.0
    """Deviation of the lamp from its expected level that is always allowed, per cent. A warm lamp usually stays within
    it. If the levels of the lamp scatter, a larger deviation is allowed. `build-lut` warns from the same value."""
    dark_percent: NotNegative = 5.0
    """Largest level of a dark frame, per cent of white. The default is half of the limit of `build-lut`. The warnings
    of `build-lut` and `acquire check` start at 0.5 %, because stray light harms dark colours."""
    ambient_percent: NotNegative = 0.2
    """Largest change of the level of dark frames since the first dark frame, per cent of white. `build-lut` warns from
    the same value."""
    light_deg: NotNegative = 0.5
    """Angle between the measured and the predicted illuminant that is always allowed, degrees. If the prediction is
    uncertain, a larger angle is allowed. The prediction is calculated from the response frames."""


class CitationSettings(Settings):
    """Information that no device provides. `build-lut` writes it into the look-up table (LUT)."""

    title: Annotated[str, Field(max_length=500)] = ""
    """Title of the LUT in citations. If empty, the camera and the illuminants are named."""
    authors: tuple[Annotated[str, Field(min_length=1, max_length=200)], ...] = ()
    """Authors, each as "Family, Given" or the name of an institution."""
    licence: Annotated[str, Field(max_length=500), AfterValidator(spdx_expression)] = ""
    """Licence of the LUT, an SPDX expression such as "CC-BY-4.0". If empty, no licence is recorded."""
    note: Annotated[str, Field(max_length=20_000)] = ""
    """Note for users of the LUT, for example on the print shop or on faults of the session."""
    url: Annotated[str, Field(max_length=500)] = ""
    """Address of the LUT, for example its DOI."""
    lens: Annotated[str, Field(max_length=500)] = ""
    """Name of the lens, if raw files do not contain it."""
    projector: Annotated[str, Field(max_length=500)] = ""
    """Name of the projector, if it cannot be read through a control port."""
    camera_serial: Literal["hash", "plain", "withheld"] = "hash"
    """Serial number of the camera in the LUT. "hash": a hash, which only distinguishes cameras. "plain": the number
    itself. "withheld": no entry."""


class SimulatedSettings(Settings):
    """The simulated laboratory."""

    body: str = "EOS 550D"
    """EOS 550D, EOS 6D Mark II or Test (small frames). Or spectral sensitivities as in `sim table --camera`: a name, or
    a file relative to the settings file."""
    camera: dict[str, Any] | None = None
    """Properties in which the camera differs from this body, with the field names of sim.world.sensors.Body."""
    seed: Annotated[int, Field(ge=0)] = 1
    """Seed of all random numbers, for example of noise and paper structure."""
    room: dict[str, bool | int | float | str] = {}
    """Physical parameters of the room that differ from the default; see sim.world.world.Room."""
    events: tuple[dict[str, Any], ...] = ()
    """Disturbances by frame or time; see sim.world.disturbances. They may be changed between two runs."""


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
    """pjlink: PJLink; serial: commands of the manufacturer over a serial port or TCP; none: switched by hand."""
    language: str | None = None
    """For ``serial``: name of a command language (docs/devices.md), or path of a language file (.toml) relative to the
    settings file."""
    host: Host | None = None
    """Address, for PJLink and for languages over TCP."""
    port: Annotated[int, Field(ge=1, le=65535)] | None = None
    """TCP port, if different from the default of the language."""
    password: Annotated[str | None, Field(repr=False)] = None
    """PJLink password. ``{ env = "NAME" }`` or ``{ file = "PATH" }`` read it from an environment variable or a file.
    `session.toml` does not contain it."""
    device: str | None = None
    """Serial port, such as /dev/ttyUSB0."""
    baud: Annotated[int, Field(ge=300)] | None = None
    """Baud rate, if different from the default of the language."""
    refresh_hz: Positive = 60.0
    """Refresh rate: images per second."""
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
    """Devices: lab (real devices) or simulated (simulated laboratory). `imported` marks a session whose frames were
    taken with other software."""
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
        """Name of the settings file, for messages."""
        return self._file

    def with_file_name(self, file: str) -> LabSettings:
        """Return a copy of the settings with the name of their file."""
        copy = self.model_copy()
        copy._file = file  # noqa: SLF001 - same class
        return copy

    def to_toml(self) -> str:
        """Return the settings with defaults as the text of `session.toml`; secrets are masked."""
        values = self.model_dump(mode="json", exclude_none=True)
        values["sequence"]["notify"] = target_label(self.sequence.notify)
        values["notify"]["alive"] = target_label(self.notify.alive)
        # Only LAB.toml contains the password.
        values["lab"]["projector"].pop("password", None)
        return tomli_w.dumps(values)


def load_lab(path: Path) -> LabSettings:
    """Read `LAB.toml`, and resolve every path against its folder; `ConfigurationError` if a value is not valid."""
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
    simulated = settings.simulated
    body, camera = file_in(folder, simulated.body), dict(simulated.camera or {})
    if isinstance(sensitivities := camera.get("sensitivities"), str):
        camera["sensitivities"] = file_in(folder, sensitivities)
    changes["simulated"] = simulated.model_copy(update={"body": body, "camera": camera or simulated.camera})
    return settings.model_copy(update=changes)


def file_in(folder: Path, name: str) -> str:
    """Return the path of a file of sensitivities that a settings file in `folder` names; other names are unchanged."""
    return str(folder / name) if name.lower().endswith(".json") or (folder / name).is_file() else name


def parse_lab(text: str, source_name: str, folder: Path | None = None) -> LabSettings:
    """Parse the settings in a TOML text without resolving paths; `ConfigurationError` if a value is not valid.

    Parameters
    ----------
    text
        TOML text.
    source_name
        Name of the text in errors.
    folder
        Folder of relative paths to files with secrets. None for `session.toml`, which contains no secrets.
    """
    document = parse_toml(text, source_name)
    if folder is not None:
        _insert_secrets(document, folder, source_name)
    return validate_settings(LabSettings, document, source_name).with_file_name(source_name)


def validate_settings(model: type[_AnySettings], document: dict[str, Any], source_name: str) -> _AnySettings:
    """Validate the settings in a document; `ConfigurationError` lists every invalid key, but no secret."""
    try:
        return model.model_validate(document)
    except ValidationError as error:
        mistakes = find_mistakes(model, document, error, _is_secret, IMPORTED_RIG)
        # The original error would show the secret in the traceback.
        has_secret = any(_is_secret(".".join(map(str, mistake["loc"]))) for mistake in error.errors())
        raise ConfigurationError(f"{source_name}:{list_mistakes(mistakes)}") from (None if has_secret else error)


def _is_secret(key: str) -> bool:
    # A table that contains a secret is secret, too.
    return any(f"{secret_key}.".startswith(f"{key}.") or key.startswith(f"{secret_key}.") for secret_key in _SECRETS)


def _insert_secrets(document: dict[str, Any], folder: Path, source_name: str) -> None:
    errors: list[ConfigurationError] = []
    for key in _SECRETS:
        *tables, name = key.split(".")
        level: Any = document
        for table_name in tables:
            level = cast("dict[str, Any]", level).get(table_name) if isinstance(level, dict) else None
        table = cast("dict[str, Any]", level) if isinstance(level, dict) else {}
        value = table.get(name)
        if isinstance(value, dict):
            source = cast("dict[str, Any]", value)
            if tables[0] == "lab" and document.get("rig") != "lab":
                # Only real devices need a password. A simulated session can run without it.
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
