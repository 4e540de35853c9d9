"""The text commands of a projector as data: commands, replies, and the meaning of the replies.

A language is one TOML file, in ``drivers/data/languages`` or at a path that the user gives. In its texts, `{}` means a
value. Replies are compared without regard to upper and lower case, to blanks, and to zeros before a value.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeVar, cast, get_args

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from drivers.links.link import MessageParser, quoted
from drivers.projector import FAULT_PARTS, Power
from foundation.errors import ConfigurationError, ProtocolError, nearest_names
from foundation.files import read_text
from foundation.records import find_mistakes, list_mistakes, parse_toml

# Folder of the built-in languages, one file each.
FOLDER: Final = Path(__file__).parents[1] / "data" / "languages"

FILE_ENDING: Final = ".toml"  # A text with this ending is the path of a language file; another text is a name

# Remedy for replies that cannot be decoded.
CHECK_SPEED: Final = "compare speed and parity with the projector's menu, and check the name of the language"

_BLANK: Final = b"\r\n\0 "  # Bytes between messages, without meaning in any language

_VALUE: Final = "{}"  # Position of the value in a text


def _require_ascii(text: str) -> str:
    if not text.isascii():
        raise ValueError("expected only ASCII characters")
    return text


def _require_value(text: str) -> str:
    if text.count(_VALUE) != 1:
        raise ValueError(f"expected a text with {_VALUE} exactly once, at the position of its value")
    return text


def _require_no_value(text: str) -> str:
    if not text or _VALUE in text:
        raise ValueError(f"expected a text without {_VALUE} that is not empty")
    return text


def _as_tuple(value: Any) -> Any:
    if isinstance(value, str):
        return (value,)
    return tuple(cast("list[Any]", value)) if isinstance(value, list) else value


def _uppercase_keys(table: dict[str, Any]) -> dict[str, Any]:
    uppercase = {key.strip().upper(): value for key, value in table.items()}
    if len(uppercase) < len(table):
        raise ValueError("expected values that differ if case is ignored")
    return uppercase


def _require_hexadecimal(text: str) -> str:
    if not re.fullmatch(r"[0-9A-Fa-f]{2}", text):
        raise ValueError('expected two hexadecimal digits, such as "0A"')
    return text.upper()


def _require_fault_part(part: str) -> str:
    if part not in FAULT_PARTS:
        raise ValueError(f"expected one of {', '.join(FAULT_PARTS)}")
    return part


Text = Annotated[str, AfterValidator(_require_ascii)]  # A text that is sent or received
FixedText = Annotated[Text, AfterValidator(_require_no_value)]  # A text without a value, not empty
FixedTexts = Annotated[tuple[FixedText, ...], BeforeValidator(_as_tuple)]  # One text without a value, or a list of them
Template = Annotated[Text, AfterValidator(_require_value)]  # A text with one value
# One text with a value, or a list of alternatives.
Templates = Annotated[tuple[Template, ...], BeforeValidator(_as_tuple), Field(min_length=1)]
State = Annotated[Power, Field(strict=False)]  # A power state, by its name
Hexadecimal = Annotated[str, AfterValidator(_require_hexadecimal)]  # A byte
Part = Annotated[str, AfterValidator(_require_fault_part)]  # One of `drivers.projector.FAULT_PARTS`


class _Table(BaseModel):
    """A table of a language file. It is frozen, and unknown keys and wrong types are errors."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, use_attribute_docstrings=True)


class LineFormat(_Table):
    """Format of commands and replies."""

    baud: Annotated[int, Field(ge=300)]
    """Speed, bit/s, as set by the maker; always with 8 data bits, no parity and 1 stop bit."""
    command: Template
    """Format of a command. `{}` is its text, and the characters after `{}` end the command."""
    answer: Template
    """Format of a reply. `{}` is its text, and the characters before `{}` may be missing."""
    ends: Annotated[Text, Field(min_length=1)]
    """Characters that end a reply."""
    unended: FixedTexts = ()
    """Replies that may arrive without any character of `ends`."""
    echo: bool = False
    """True if the projector may repeat a command before its reply."""
    prompt: Text = ""
    """Text that the projector sends when it is ready for a command; empty if it sends none."""
    wake: Text = ""
    """Text that is sent first over a new connection, and has a reply; empty if none is needed."""
    timeout_s: Annotated[float, Field(gt=0, le=60)] = 5.0
    """Longest time until a reply, seconds."""

    @model_validator(mode="after")
    def _check_ends(self) -> LineFormat:
        if not self.command.partition(_VALUE)[2]:
            raise ValueError(f"command = {self.command!r}: expected the characters that end a command after {_VALUE}")
        prefix, _, suffix = self.answer.partition(_VALUE)
        blank = _BLANK.decode("ascii")
        if not any(character in suffix for character in self.ends) or suffix.strip(blank) not in ("", *self.ends):
            raise ValueError(
                f"answer = {self.answer!r}: expected one of the characters of ends = {self.ends!r} after {_VALUE}, "
                "and no others"
            )
        self.require_received("answer", prefix.strip(blank))
        for text in self.unended:
            self.require_received("unended", text)
        return self

    def require_received(self, key: str, text: str) -> None:
        """Refuse a text with a character that ends a reply, because no received reply can contain it."""
        if any(character in text for character in self.ends):
            raise ValueError(f"{key} has {text!r}: expected a text without the characters of line.ends")


class Handshake(_Table):
    """First messages of a connection over TCP."""

    send: Text
    """Text that is sent over a new connection."""
    answer_begins: Text
    """First characters of the reply."""
    answer_length: Annotated[int, Field(ge=1, le=256)]
    """Length of the reply, bytes."""
    state_at: Annotated[int, Field(ge=0, le=255)]
    """Position of the state byte in the reply, from 0."""
    accepted: Hexadecimal
    """State byte of an accepted connection, two hexadecimal digits."""
    refusals: Annotated[dict[Hexadecimal, str], AfterValidator(_uppercase_keys)] = {}
    """Message with a remedy for each other state byte."""

    @model_validator(mode="after")
    def _check_state_position(self) -> Handshake:
        if self.state_at >= self.answer_length:
            raise ValueError(f"state_at = {self.state_at}: expected a value below answer_length = {self.answer_length}")
        return self


class Network(_Table):
    """Use of the language over TCP."""

    port: Annotated[int, Field(ge=1, le=65535)]
    """TCP port."""
    handshake: Handshake | None = None
    """Handshake of a new connection; None if the connection starts with the first command."""


class Refusals(_Table):
    """Replies that refuse a command or query."""

    unknown: FixedTexts = ()
    """Replies if the projector does not support the command."""
    busy: FixedTexts = ()
    """Replies if it cannot execute the command now; to the power query, they mean warm-up or cooling."""
    unclear: FixedTexts = ()
    """Replies that mean either `unknown` or `busy`; for an optional query, `unknown` if the projector is on."""

    @model_validator(mode="after")
    def _check_not_empty(self) -> Refusals:
        if not (self.unknown or self.busy or self.unclear):
            raise ValueError("expected at least one refusing reply in unknown, busy or unclear")
        return self

    @property
    def all(self) -> tuple[str, ...]:
        """Refusing replies of every kind."""
        return (*self.unknown, *self.busy, *self.unclear)


class Question(_Table):
    """A query and its accepted replies."""

    ask: FixedText
    """Text of the query."""
    answer: Templates
    """Text of the reply."""


class TextQuestion(Question):
    """A query for a name."""

    shown: Template = _VALUE
    """Format of the reported name."""


class _Commands(_Table):
    """Commands for the two values of a setting."""

    on: FixedText
    """Command that switches the projector on (`power`) or mutes the image (`mute`)."""
    off: FixedText
    """Command that switches the projector off (`power`) or shows the image (`mute`)."""
    done: Text
    """Reply to both commands. It may contain `{}` for the new state; the driver accepts any value."""

    @model_validator(mode="after")
    def _check_difference(self) -> _Commands:
        if self.on.upper() == self.off.upper():
            raise ValueError(f"on and off are both {self.on!r}: expected two different commands, none that toggles")
        return self


class PowerCommands(_Commands, Question):
    """Commands and replies for the power state."""

    states: Annotated[dict[str, State], AfterValidator(_uppercase_keys)]
    """Meaning of the values: on, standby, warm-up or cooling. Warm-up and cooling are optional."""
    stopped: Annotated[dict[str, str], AfterValidator(_uppercase_keys)] = {}
    """Values of fault states that end only if a person acts, each with a remedy."""
    done_within_s: Annotated[float, Field(ge=0, le=600)] = 0.0
    """Longest time until the reply `done`, seconds, if it is sent after switching; 0 if it is sent at once."""

    @model_validator(mode="after")
    def _check_states(self) -> PowerCommands:
        for required in (Power.ON, Power.STANDBY):
            if required not in self.states.values():
                raise ValueError(f'expected a value for "{required.value}" in states')
        if duplicates := self.states.keys() & self.stopped.keys():
            raise ValueError(f"{', '.join(sorted(duplicates))}: expected each value in only one of states and stopped")
        return self

    def value_of(self, power: Power) -> str | None:
        """Return the first value that means a power state; None if no value does."""
        return next((value for value, meaning in self.states.items() if meaning is power), None)


class MuteCommands(_Commands):
    """Commands and replies for the image mute."""

    ask: Text = ""
    """Text of the query, which requires `states`. If empty, there is no query, and the last command counts."""
    answer: Templates = (_VALUE,)
    """Text of the reply."""
    states: Annotated[dict[str, bool], AfterValidator(_uppercase_keys)] = {}
    """Meaning of the values: true if the image is muted."""
    only_changes: bool = False
    """True if the projector may refuse a command that changes nothing; it is then not sent."""

    @model_validator(mode="after")
    def _check_states(self) -> MuteCommands:
        if self.ask and set(self.states.values()) != {True, False}:
            raise ValueError("ask is given: expected states with a value for true and one for false")
        if not self.ask and "answer" in self.model_fields_set:
            raise ValueError("answer is given without ask: expected both")
        return self

    def value_of(self, muted: bool) -> str:
        """Return the value of a mute state; empty if the language has no values."""
        return next((value for value, meaning in self.states.items() if meaning is muted), "")


class FaultWords(Question):
    """Query and replies for faults; several faults are separated by spaces."""

    healthy: FixedText
    """Value that means "no fault"."""
    parts: Annotated[dict[str, Part], AfterValidator(_uppercase_keys), Field(min_length=1)]
    """Faulty component by value; a value that is not listed means "other"."""
    digits: Annotated[int, Field(ge=0, le=8)] = 0
    """Number of hexadecimal digits of each value; 0 if any word is permitted."""

    @model_validator(mode="after")
    def _check_values(self) -> FaultWords:
        for value in (self.healthy, *self.parts):
            if len(value.split()) != 1:
                raise ValueError(f"{value!r}: expected one word, because a space separates two faults")
            if not self.is_valid(value):
                raise ValueError(f"{value!r}: expected {self.digits} hexadecimal digits (key digits)")
        if self.healthy.upper() in self.parts:
            raise ValueError(f"healthy = {self.healthy!r}: expected a value that is not in parts")
        return self

    def is_valid(self, value: str) -> bool:
        """Return whether a word has the form of a value."""
        return not self.digits or re.fullmatch(f"[0-9A-Fa-f]{{{self.digits}}}", value) is not None


class Unasked(_Table):
    """A message that the projector sends without a query."""

    text: Text
    """The message; `{}` matches any text."""
    power: State | None = None
    """Power state that the message announces."""
    fault: Part | None = None
    """Faulty component that the message announces; it is reported until the next warm-up."""


class Language(_Table):
    """The text commands of a projector, as in a language file."""

    maker: str
    """Maker, used in messages and records."""
    source: str
    """Manual with these commands."""
    line: LineFormat
    network: Network | None = None
    refusals: Refusals
    power: PowerCommands
    mute: MuteCommands
    faults: FaultWords | None = None
    lamp_hours: Question | None = None
    model: TextQuestion | None = None
    name: TextQuestion | None = None
    unasked: Annotated[tuple[Unasked, ...], BeforeValidator(_as_tuple)] = ()

    @model_validator(mode="after")
    def _check_replies(self) -> Language:
        table_names = ("power", "mute", "faults", "lamp_hours", "model", "name")
        tables = {key: table for key in table_names if (table := getattr(self, key)) is not None}
        replies = {f"{key}.answer": table.answer for key, table in tables.items()}
        replies |= {f"{key}.done": (table.done,) for key, table in tables.items() if isinstance(table, _Commands)}
        for key, texts in replies.items():
            for text in texts:
                self.line.require_received(key, text)
                if text and refusal_kind(self.refusals, text) is not None:
                    raise ValueError(f"{key} = {text!r} is also one of the refusals: expected a different text")
                if self.match_unasked(text) is not None:
                    raise ValueError(f"{key} = {text!r} is also one of the unasked messages: expected a different text")
        messages = {"refusals": self.refusals.all, "unasked": tuple(message.text for message in self.unasked)}
        for key, texts in messages.items():
            for text in texts:
                self.line.require_received(key, text)
        return self

    def match_unasked(self, text: str) -> Unasked | None:
        """Return the first unasked message that matches a text; None if none matches."""
        return next((message for message in self.unasked if match_value((message.text,), text) is not None), None)

    @property
    def announces_power(self) -> bool:
        """True if the projector announces its power states."""
        return any(message.power is not None for message in self.unasked)

    @property
    def reports_unasked(self) -> bool:
        """True if unasked messages report a power state or a fault."""
        return any(message.power is not None or message.fault is not None for message in self.unasked)


def built_in_languages() -> tuple[str, ...]:
    """Return the names of the built-in languages."""
    return tuple(sorted(path.stem for path in FOLDER.glob(f"*{FILE_ENDING}")))


def load_language(named: str) -> Language:
    """Return the built-in language `named`, or the language of a file if `named` ends with ``.toml``."""
    path, languages = Path(named), built_in_languages()
    if not named.lower().endswith(FILE_ENDING):
        if named.lower() not in languages:
            near = nearest_names(named, languages)
            raise ConfigurationError(
                f"projector language {named!r} does not exist, expected {', '.join(languages)}, "
                f"or the path of a file that ends with {FILE_ENDING}; {near or 'correct it'}"
            )
        path = FOLDER / f"{named.lower()}{FILE_ENDING}"
    text = read_text(path, "write one as described in docs/reference/language-files.md", "language file")
    return parse_language(text, str(path))


def parse_language(text: str, where: str) -> Language:
    """Return the language in a TOML text; `where` is its name in error messages."""
    document = parse_toml(text, where)
    try:
        return Language.model_validate(document)
    except ValidationError as error:
        mistakes = list_mistakes(find_mistakes(Language, document, error))
        raise ConfigurationError(f"{where}:{mistakes}; see {FOLDER} for examples") from error


def encode_command(line: LineFormat, text: str) -> bytes:
    """Return the bytes of a command."""
    return line.command.replace(_VALUE, text).encode("ascii")


def encode_answer(line: LineFormat, text: str) -> bytes:
    """Return the bytes of a reply; line ends before an empty reply are left out."""
    framed = line.answer.replace(_VALUE, text)
    return (framed if text else framed.lstrip("\r\n")).encode("ascii")


def answer_parser(language: Language, sent: str = "") -> MessageParser[str]:
    """Return a parser of one reply, which returns its text without prefix and end characters.

    The parser skips an echo of the command `sent`. Echo and reply may be the same text. If only one of them arrives and
    a prompt follows, it was the reply. A reply without an end character may also end where an unasked message starts.
    """
    line = language.line
    ends = [character.encode("ascii") for character in line.ends]
    prefix, prompt = line.answer.partition(_VALUE)[0].encode("ascii"), line.prompt.encode("ascii")

    def parse(data: bytes) -> tuple[str, int] | None:
        start, has_echo = 0, False
        while True:
            start = len(data) - len(data[start:].lstrip(_BLANK))
            if prompt and data.startswith(prompt, start):
                start += len(prompt)
                if has_echo:
                    return sent, start
                continue
            start += len(prefix) if data.startswith(prefix, start) else 0
            end_positions = [end for end in (data.find(character, start) for character in ends) if end >= 0]
            text = decode_text(data[start : min(end_positions, default=len(data))].strip(_BLANK))
            if not end_positions:
                return (text, len(data)) if text in line.unended else None
            for word in line.unended:
                rest = text.removeprefix(word).removeprefix(prefix.decode())
                if text.startswith(word) and language.match_unasked(rest):
                    return word, data.index(word.encode("ascii"), start) + len(word)
            start = min(end_positions) + 1
            # Only the echo of a query may differ in case, because the reply to the command pow=on is POW=ON.
            is_echo = text == sent or ("?" in sent and text.upper() == sent.upper())
            if not line.echo or not is_echo or has_echo:
                return text, start
            has_echo = True

    return parse


def handshake_parser(handshake: Handshake) -> MessageParser[str]:
    """Return a parser of the reply to a handshake, which returns the state byte as hexadecimal digits."""
    prefix = handshake.answer_begins.encode("ascii")

    def parse(data: bytes) -> tuple[str, int] | None:
        if not prefix.startswith(data[: len(prefix)]):
            raise ProtocolError(f"the projector greets with {quoted(data)}, expected {quoted(prefix)}; check the port")
        if len(data) < handshake.answer_length:
            return None
        return f"{data[handshake.state_at]:02X}", handshake.answer_length

    return parse


def decode_text(data: bytes) -> str:
    """Return printable ASCII as text; other bytes raise a ProtocolError."""
    if any(not 0x20 <= byte < 0x7F for byte in data):
        raise ProtocolError(f"the projector sends {quoted(data)}, expected ASCII text; {CHECK_SPEED}")
    return data.decode("ascii")


def match_value(templates: Iterable[str], text: str) -> str | None:
    """Return the value in the first template that matches, "" if it has no value, None if no template matches."""
    for template in templates:
        match = _pattern(template).fullmatch(text)
        if match is not None:
            return match[1].strip() if match.groups() else ""
    return None


_State = TypeVar("_State")


def state_of(states: Mapping[str, _State], value: str) -> _State | None:
    """Return the meaning of a value, also if it has more or fewer zeros before it than in the language."""
    values = {key.lstrip("0") or key[:1]: state for key, state in states.items()}
    return values.get(value.upper().lstrip("0") or value[:1])


@cache
def _pattern(template: str) -> re.Pattern[str]:
    pattern = re.escape(template).replace(re.escape(_VALUE), "(.*)").replace(r"\ ", r"\s*").replace("=", r"\s*=\s*")
    return re.compile(pattern, re.IGNORECASE)


Refusal = Literal["unknown", "busy", "unclear"]  # Fields of `Refusals`


def refusal_kind(refusals: Refusals, text: str) -> Refusal | None:
    """Return the kind of a refusal; None if the reply is not a refusal."""
    return next((kind for kind in get_args(Refusal) if match_value(getattr(refusals, kind), text) is not None), None)
