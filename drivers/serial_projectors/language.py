"""A projector's line protocol as data: what is sent, what is answered, and what the answers mean.

A language is one TOML file. `{}` stands for a value in a text, and capitals and small letters are alike in answers.
The languages that come with the suite lie in ``drivers/data/languages``; a user names a file of their own by its path.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from drivers.links.link import MessageParser, quoted
from drivers.projector import FAULT_PARTS, Power
from foundation.errors import ConfigurationError, ProtocolError
from foundation.files import read_text
from foundation.records import known_keys, unknown_key

FOLDER: Final = Path(__file__).parents[1] / "data" / "languages"
"""The languages that come with the suite, a file each."""

FILE_ENDING: Final = ".toml"
"""What tells the path of a language file from the name of a language."""

CHECK_SPEED: Final = "check that speed and parity are those set in the projector's menu, and that its language is right"
"""The remedy against bytes that make no sense."""

_BLANK: Final = b"\r\n\0 "
"""Bytes between two messages that mean nothing in any language."""

_VALUE: Final = "{}"


def _in_bytes(text: str) -> str:
    if not text.isascii():
        raise ValueError("ASCII characters were expected")
    return text


def _with_value(text: str) -> str:
    if text.count(_VALUE) != 1:
        raise ValueError(f"a text with {_VALUE} where its value stands was expected")
    return text


def _as_list(given: Any) -> Any:
    return [given] if isinstance(given, str) else given


def _in_capitals(table: dict[str, Any]) -> dict[str, Any]:
    return {key.upper(): value for key, value in table.items()}


def _fault_part(part: str) -> str:
    if part not in FAULT_PARTS:
        raise ValueError(f"expected one of {', '.join(FAULT_PARTS)}")
    return part


Words = Annotated[str, AfterValidator(_in_bytes)]
"""A text that is sent or received."""
Template = Annotated[Words, AfterValidator(_with_value)]
"""A text that holds one value."""
Templates = Annotated[tuple[Template, ...], BeforeValidator(_as_list), Field(min_length=1)]
"""A text that holds one value, or several such texts of which any may come."""
Part = Annotated[str, AfterValidator(_fault_part)]
"""What is faulty, as `drivers.projector.Fault` calls it."""


class _Table(BaseModel):
    """A table of a language file: frozen, and an unknown key is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)


class LineFormat(_Table):
    """How commands and answers are written."""

    baud: Annotated[int, Field(ge=300)]
    """Speed as the projector leaves the factory; 8 data bits, no parity, 1 stop bit."""
    command: Template
    """A command as it is sent; `{}` is its text."""
    answer: Template
    """An answer as it is received; `{}` is its text. What stands before `{}` may be missing."""
    ends: Annotated[Words, Field(min_length=1)]
    """Characters of which each ends an answer."""
    unended: tuple[Words, ...] = ()
    """Answers that may come without such a character."""
    echo: bool = False
    """Whether the projector may repeat what it received before it answers."""
    prompt: Words = ""
    """What the projector writes when it is ready for a command; empty if it writes nothing."""
    wake: Words = ""
    """What is sent over a new connection before the first command, and is answered; empty for nothing."""
    timeout_s: Annotated[float, Field(gt=0, le=60)] = 5.0
    """Longest time to an answer."""


class Handshake(_Table):
    """What a connection over TCP begins with."""

    send: Words
    """What is sent."""
    answer_begins: Words
    """What the answer begins with."""
    answer_length: Annotated[int, Field(ge=1, le=256)]
    """Bytes of the answer."""
    state_at: Annotated[int, Field(ge=0, le=255)]
    """Position of the byte that holds the state."""
    accepted: str
    """The state of a connection that is accepted, two hexadecimal digits."""
    refusals: Annotated[dict[str, str], AfterValidator(_in_capitals)] = {}
    """Other states, and what is wrong and what to do about it."""

    @model_validator(mode="after")
    def _state_in_answer(self) -> Handshake:
        if self.state_at >= self.answer_length:
            raise ValueError(f"state_at = {self.state_at} was expected below answer_length = {self.answer_length}")
        return self


class Network(_Table):
    """The same language over TCP."""

    port: Annotated[int, Field(ge=1, le=65535)]
    """TCP port."""
    handshake: Handshake | None = None
    """What a connection begins with; None for the first command."""


class Refusals(_Table):
    """Answers that refuse a command or a question."""

    unknown: tuple[Words, ...] = ()
    """The projector does not have it."""
    busy: tuple[Words, ...] = ()
    """Not now. The power state is refused in this way only in warm-up and cooling."""
    unclear: tuple[Words, ...] = ()
    """Either of both; from a projector that is on, the former."""

    @model_validator(mode="after")
    def _any(self) -> Refusals:
        if not (self.unknown or self.busy or self.unclear):
            raise ValueError("at least one answer that refuses was expected, as unknown, busy or unclear")
        return self


class Question(_Table):
    """A question, and the answers that are understood."""

    ask: Words
    """The text of the question."""
    answer: Templates
    """The text of the answer."""


class TextQuestion(Question):
    """A question after a name."""

    shown: Template = _VALUE
    """The name as it is reported."""


class PowerWords(Question):
    """The power state."""

    states: Annotated[dict[str, Power], AfterValidator(_in_capitals)]
    """What the values mean: on, standby, warm-up or cooling. A language may lack the last two."""
    stopped: Annotated[dict[str, str], AfterValidator(_in_capitals)] = {}
    """Values of a state that needs help, and what to do."""
    on: Words
    """Switches on."""
    off: Words
    """Switches off."""
    done: Words
    """What is answered to both; `{}` is the value of the state."""
    done_within_s: Annotated[float, Field(ge=0, le=600)] = 0.0
    """Longest time to that answer if it comes only when the lamp has struck, or gone out; 0: it comes at once."""

    @model_validator(mode="after")
    def _both_ends(self) -> PowerWords:
        for needed in (Power.ON, Power.STANDBY):
            if needed not in self.states.values():
                raise ValueError(f'a value for "{needed.value}" was expected among the states')
        return self

    def value_of(self, power: Power) -> str | None:
        """Return the first value for a state; None if there is none."""
        return next((value for value, meaning in self.states.items() if meaning is power), None)


class MuteWords(_Table):
    """The picture that is hidden, or shown."""

    ask: Words = ""
    """The text of the question; empty if there is none, and what was set last counts."""
    answer: Templates = (_VALUE,)
    """The text of the answer."""
    states: Annotated[dict[str, bool], AfterValidator(_in_capitals)] = {}
    """What the values mean: true if the picture is hidden."""
    on: Words
    """Hides the picture."""
    off: Words
    """Shows the picture."""
    done: Words
    """What is answered to both; `{}` is the value of the state."""
    only_changes: bool = False
    """Whether a command that changes nothing may be refused, and is not sent."""

    def value_of(self, muted: bool) -> str:
        """Return the value of a state; empty if there is none."""
        return next((value for value, meaning in self.states.items() if meaning is muted), "")


class FaultWords(Question):
    """The faults; several are separated by spaces."""

    healthy: Words
    """The value without a fault."""
    parts: Annotated[dict[str, Part], AfterValidator(_in_capitals)]
    """What the values mean; all others mean another part."""


class Unasked(_Table):
    """A message that the projector sends without a question."""

    text: Words
    """The message; `{}` stands for anything."""
    power: Power | None = None
    """The power state that begins."""
    fault: Part | None = None
    """The part that fails; it is reported until the lamp is struck again."""


class Language(_Table):
    """A projector's language, as its file describes it."""

    maker: str
    """Maker, for messages and records."""
    source: str
    """Manual that the language is from."""
    line: LineFormat
    network: Network | None = None
    refusals: Refusals
    power: PowerWords
    mute: MuteWords
    faults: FaultWords | None = None
    lamp_hours: Question | None = None
    model: TextQuestion | None = None
    name: TextQuestion | None = None
    unasked: tuple[Unasked, ...] = ()

    @property
    def announces_power(self) -> bool:
        """Whether warm-up and cooling are announced, and not asked for."""
        return any(message.power is not None for message in self.unasked)

    @property
    def has_news(self) -> bool:
        """Whether messages that come unasked have a meaning."""
        return any(message.power is not None or message.fault is not None for message in self.unasked)


def built_in_languages() -> tuple[str, ...]:
    """Return the names of the languages that come with the suite."""
    return tuple(sorted(path.stem for path in FOLDER.glob(f"*{FILE_ENDING}")))


def load_language(named: str) -> Language:
    """Return the language of a name, or of a file if `named` ends with ``.toml``."""
    if named.lower().endswith(FILE_ENDING):
        return _read_language(Path(named))
    if named.lower() not in built_in_languages():
        raise ConfigurationError(
            f"no projector language {named!r}; expected {', '.join(built_in_languages())}, "
            f"or the path of a file that ends with {FILE_ENDING}"
        )
    return _read_language(FOLDER / f"{named.lower()}{FILE_ENDING}")


def _read_language(path: Path) -> Language:
    text = read_text(path, "write one as docs/devices.md describes", "language file")
    return parse_language(text, str(path))


def parse_language(text: str, where: str) -> Language:
    """Return the language in a TOML text; `where` names it in errors."""
    try:
        return Language.model_validate(tomllib.loads(text))
    except ValidationError as error:
        mistakes = "; ".join(_mistake(one["type"], one["loc"], one["msg"], one["input"]) for one in error.errors())
        raise ConfigurationError(f"{where}: {mistakes}; see {FOLDER} for examples") from error
    except (ValueError, RecursionError) as error:
        raise ConfigurationError(f"{where} is not TOML: {error}; see {FOLDER} for examples") from error


def _mistake(kind: str, place: tuple[int | str, ...], reason: str, given: Any) -> str:
    key = ".".join(map(str, place))
    if kind == "extra_forbidden":
        return unknown_key(key, known_keys(Language, place[:-1]))
    if kind == "missing":
        return f"{key} is missing; add it"
    value = "" if isinstance(given, dict) else f" = {given!r}"
    return f"{key}{value}: {reason.removeprefix('Value error, ')}"


def encode_command(line: LineFormat, text: str) -> bytes:
    """Return the bytes of a command."""
    return line.command.replace(_VALUE, text).encode("ascii")


def encode_answer(line: LineFormat, text: str) -> bytes:
    """Return the bytes of an answer; an empty one has no line of its own."""
    whole = line.answer.replace(_VALUE, text)
    return (whole if text else whole.lstrip("\r\n")).encode("ascii")


def answer_parser(line: LineFormat, sent: str = "") -> MessageParser[str]:
    """Return what takes one answer, without its framing, off the front of the bytes.

    `sent`: the command before it, whose echo is passed over. If the echo and the answer are alike and only one of them
    comes, the prompt after it shows that it was the answer.
    """
    ends = [character.encode("ascii") for character in line.ends]
    begin = line.answer.partition(_VALUE)[0]
    prompt = line.prompt.encode("ascii")

    def take(data: bytes) -> tuple[str, int] | None:
        place, echoed = 0, False
        while True:
            place = len(data) - len(data[place:].lstrip(_BLANK))
            if prompt and data.startswith(prompt, place):
                place += len(prompt)
                if echoed:
                    return sent, place
                continue
            found = [end for end in (data.find(character, place) for character in ends) if end >= 0]
            text = text_of(data[place : min(found, default=len(data))].strip(_BLANK)).removeprefix(begin)
            if not found:
                return (text, len(data)) if text in line.unended else None
            place = min(found) + 1
            if not line.echo or text != sent or echoed:
                return text, place
            echoed = True

    return take


def handshake_parser(handshake: Handshake) -> MessageParser[str]:
    """Return what takes the answer to a handshake off the front of the bytes, and returns its state."""
    begin = handshake.answer_begins.encode("ascii")

    def take(data: bytes) -> tuple[str, int] | None:
        if not begin.startswith(data[: len(begin)]):
            raise ProtocolError(f"the projector greets with {quoted(data)}, not with {quoted(begin)}; check the port")
        if len(data) < handshake.answer_length:
            return None
        return f"{data[handshake.state_at]:02X}", handshake.answer_length

    return take


def text_of(data: bytes) -> str:
    """Return printable ASCII as text."""
    if any(not 0x20 <= byte < 0x7F for byte in data):
        raise ProtocolError(f"the projector sends {quoted(data)}, which is no text; {CHECK_SPEED}")
    return data.decode("ascii")


def value_in(templates: Iterable[str], text: str) -> str | None:
    """Return the value in a text of one of these templates, "" if that has none; None if it is of none of them."""
    for template in templates:
        found = _pattern(template).fullmatch(text)
        if found is not None:
            return found[1].strip() if found.groups() else ""
    return None


@cache
def _pattern(template: str) -> re.Pattern[str]:
    return re.compile(re.escape(template).replace(re.escape(_VALUE), "(.*)"), re.IGNORECASE)


Refusal = Literal["unknown", "busy", "unclear"]
"""The kinds of `Refusals`."""


def refusal_in(refusals: Refusals, text: str) -> Refusal | None:
    """Return in which way an answer refuses; None if it does not."""
    kinds: dict[Refusal, tuple[str, ...]] = {
        "unknown": refusals.unknown,
        "busy": refusals.busy,
        "unclear": refusals.unclear,
    }
    for kind, words in kinds.items():
        if any(text.upper() == word.upper() for word in words):
            return kind
    return None
