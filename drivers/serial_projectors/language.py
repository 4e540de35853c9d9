"""A projector's line protocol as data: what is sent, what is answered, and what the answers mean.

A language is one TOML file. `{}` stands for a value in a text, and capitals and small letters are alike in answers.
The languages that come with the suite lie in ``drivers/data/languages``; a user names a file of their own by its path.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Final, Literal, cast, get_args

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from drivers.links.link import MessageParser, quoted
from drivers.projector import FAULT_PARTS, Power
from foundation.errors import ConfigurationError, ProtocolError, nearest_names
from foundation.files import read_text
from foundation.records import find_mistakes, list_mistakes, parse_toml

FOLDER: Final = Path(__file__).parents[1] / "data" / "languages"  # The languages that come with the suite, a file each

FILE_ENDING: Final = ".toml"  # What tells the path of a language file from the name of a language

# The remedy against bytes that make no sense.
CHECK_SPEED: Final = "check that speed and parity are those set in the projector's menu, and that its language is right"

_BLANK: Final = b"\r\n\0 "  # Bytes between two messages that mean nothing in any language

_VALUE: Final = "{}"


def _in_bytes(text: str) -> str:
    if not text.isascii():
        raise ValueError("ASCII characters were expected")
    return text


def _with_value(text: str) -> str:
    if text.count(_VALUE) != 1:
        raise ValueError(f"a text with {_VALUE} where its value stands was expected")
    return text


def _without_value(text: str) -> str:
    if not text or _VALUE in text:
        raise ValueError(f"a text without {_VALUE} was expected, as it is sent or received")
    return text


def _as_tuple(given: Any) -> Any:
    if isinstance(given, str):
        return (given,)
    return tuple(cast("list[Any]", given)) if isinstance(given, list) else given


def _in_capitals(table: dict[str, Any]) -> dict[str, Any]:
    changed = {key.strip().upper(): value for key, value in table.items()}
    if len(changed) < len(table):
        raise ValueError("values that differ in more than capitals were expected")
    return changed


def _hexadecimal(text: str) -> str:
    if not re.fullmatch(r"[0-9A-Fa-f]{2}", text):
        raise ValueError('two hexadecimal digits were expected, as in "0A"')
    return text.upper()


def _fault_part(part: str) -> str:
    if part not in FAULT_PARTS:
        raise ValueError(f"expected one of {', '.join(FAULT_PARTS)}")
    return part


Words = Annotated[str, AfterValidator(_in_bytes)]  # A text that is sent or received
PlainWords = Annotated[Words, AfterValidator(_without_value)]  # A text that holds no value, and is not empty
Texts = Annotated[tuple[PlainWords, ...], BeforeValidator(_as_tuple)]  # Such a text, or a list of them
Template = Annotated[Words, AfterValidator(_with_value)]  # A text that holds one value
# A text that holds one value, or several such texts of which any may come.
Templates = Annotated[tuple[Template, ...], BeforeValidator(_as_tuple), Field(min_length=1)]
State = Annotated[Power, Field(strict=False)]  # A power state, by its name
Hexadecimal = Annotated[str, AfterValidator(_hexadecimal)]  # A byte
Part = Annotated[str, AfterValidator(_fault_part)]  # What is faulty, as `drivers.projector.Fault` calls it


class _Table(BaseModel):
    """A table of a language file: frozen, and an unknown key, or a text in place of a number, is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, use_attribute_docstrings=True)


class LineFormat(_Table):
    """How commands and answers are written."""

    baud: Annotated[int, Field(ge=300)]
    """Speed as the projector leaves the factory; 8 data bits, no parity, 1 stop bit."""
    command: Template
    """A command as it is sent; `{}` is its text. What stands after `{}` ends the command."""
    answer: Template
    """An answer as it is received; `{}` is its text. What stands before `{}` may be missing."""
    ends: Annotated[Words, Field(min_length=1)]
    """Characters of which each ends an answer."""
    unended: Texts = ()
    """Answers that may come without such a character."""
    echo: bool = False
    """Whether the projector may repeat what it received before it answers."""
    prompt: Words = ""
    """What the projector writes when it is ready for a command; empty if it writes nothing."""
    wake: Words = ""
    """What is sent over a new connection before the first command, and is answered; empty for nothing."""
    timeout_s: Annotated[float, Field(gt=0, le=60)] = 5.0
    """Longest time to an answer."""

    @model_validator(mode="after")
    def _ends_are_written(self) -> LineFormat:
        if not self.command.partition(_VALUE)[2]:
            raise ValueError(f"command = {self.command!r}: characters that end a command were expected after {_VALUE}")
        begin, _, end = self.answer.partition(_VALUE)
        blank = _BLANK.decode("ascii")
        if not any(character in end for character in self.ends) or end.strip(blank) not in ("", *self.ends):
            raise ValueError(
                f"answer = {self.answer!r}: after {_VALUE} one of the characters of ends = {self.ends!r} was expected, "
                "and no others"
            )
        self.require_received("answer", begin.strip(blank))
        for text in self.unended:
            self.require_received("unended", text)
        return self

    def require_received(self, key: str, text: str) -> None:
        """Refuse a text that an answer cannot hold, since a character in it ends the answer."""
        if any(character in text for character in self.ends):
            raise ValueError(f"{key} has {text!r}: a text without the characters of line.ends was expected")


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
    accepted: Hexadecimal
    """The state of a connection that is accepted, two hexadecimal digits."""
    refusals: Annotated[dict[Hexadecimal, str], AfterValidator(_in_capitals)] = {}
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

    unknown: Texts = ()
    """The projector does not have it."""
    busy: Texts = ()
    """Not now. The power state is refused in this way only in warm-up and cooling."""
    unclear: Texts = ()
    """Either of both; from a projector that is on, the former."""

    @model_validator(mode="after")
    def _any(self) -> Refusals:
        if not (self.unknown or self.busy or self.unclear):
            raise ValueError("at least one answer that refuses was expected, as unknown, busy or unclear")
        return self

    @property
    def all(self) -> tuple[str, ...]:
        """All of them."""
        return (*self.unknown, *self.busy, *self.unclear)


class Question(_Table):
    """A question, and the answers that are understood."""

    ask: PlainWords
    """The text of the question."""
    answer: Templates
    """The text of the answer."""


class TextQuestion(Question):
    """A question after a name."""

    shown: Template = _VALUE
    """The name as it is reported."""


class _Commands(_Table):
    """Two commands for the two values of a setting."""

    on: PlainWords
    """Switches on, or hides the picture."""
    off: PlainWords
    """Switches off, or shows the picture."""
    done: Words
    """The answer to both. It may have a `{}`, the value of the new state; the driver takes any value for it."""

    @model_validator(mode="after")
    def _differ(self) -> _Commands:
        if self.on.upper() == self.off.upper():
            raise ValueError(f"on and off are both {self.on!r}: two commands were expected, none that toggles")
        return self


class PowerWords(_Commands, Question):
    """The power state."""

    states: Annotated[dict[str, State], AfterValidator(_in_capitals)]
    """What the values mean: on, standby, warm-up or cooling. A language may lack the last two."""
    stopped: Annotated[dict[str, str], AfterValidator(_in_capitals)] = {}
    """Values of a state that needs help, and what to do."""
    done_within_s: Annotated[float, Field(ge=0, le=600)] = 0.0
    """Longest time to that answer if it comes only when the lamp has struck, or gone out; 0: it comes at once."""

    @model_validator(mode="after")
    def _both_ends(self) -> PowerWords:
        for needed in (Power.ON, Power.STANDBY):
            if needed not in self.states.values():
                raise ValueError(f'a value for "{needed.value}" was expected among the states')
        if both := self.states.keys() & self.stopped.keys():
            raise ValueError(f"{', '.join(sorted(both))}: a value either of states or of stopped was expected")
        return self

    def value_of(self, power: Power) -> str | None:
        """Return the first value for a state; None if there is none."""
        return next((value for value, meaning in self.states.items() if meaning is power), None)


class MuteWords(_Commands):
    """The picture that is hidden, or shown."""

    ask: Words = ""
    """The text of the question; empty if there is none, and what was set last counts. With it, `states` are needed."""
    answer: Templates = (_VALUE,)
    """The text of the answer."""
    states: Annotated[dict[str, bool], AfterValidator(_in_capitals)] = {}
    """What the values mean: true if the picture is hidden."""
    only_changes: bool = False
    """Whether a command that changes nothing may be refused, and is not sent."""

    @model_validator(mode="after")
    def _states_if_asked(self) -> MuteWords:
        if self.ask and set(self.states.values()) != {True, False}:
            raise ValueError("states with a value for true and one for false were expected, since ask is given")
        if not self.ask and "answer" in self.model_fields_set:
            raise ValueError("answer is given without ask: the question was expected, too")
        return self

    def value_of(self, muted: bool) -> str:
        """Return the value of a state; empty if there is none."""
        return next((value for value, meaning in self.states.items() if meaning is muted), "")


class FaultWords(Question):
    """The faults; several are separated by spaces."""

    healthy: PlainWords
    """The value without a fault."""
    parts: Annotated[dict[str, Part], AfterValidator(_in_capitals), Field(min_length=1)]
    """What the values mean; all others mean another part."""
    digits: Annotated[int, Field(ge=0, le=8)] = 0
    """Hexadecimal digits of every value; 0 if any word may come."""

    @model_validator(mode="after")
    def _single_words(self) -> FaultWords:
        for value in (self.healthy, *self.parts):
            if len(value.split()) != 1:
                raise ValueError(f"{value!r}: one word was expected, since a space separates two faults")
            if not self.may_be(value):
                raise ValueError(f"{value!r}: {self.digits} hexadecimal digits were expected, as digits says")
        if self.healthy.upper() in self.parts:
            raise ValueError(f"healthy = {self.healthy!r}: a value that is none of the parts was expected")
        return self

    def may_be(self, value: str) -> bool:
        """Return whether a word can be a value."""
        return not self.digits or re.fullmatch(f"[0-9A-Fa-f]{{{self.digits}}}", value) is not None


class Unasked(_Table):
    """A message that the projector sends without a question."""

    text: Words
    """The message; `{}` stands for anything."""
    power: State | None = None
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
    unasked: Annotated[tuple[Unasked, ...], BeforeValidator(_as_tuple)] = ()

    @model_validator(mode="after")
    def _answers_arrive(self) -> Language:
        named = ("power", "mute", "faults", "lamp_hours", "model", "name")
        parts = {key: part for key in named if (part := getattr(self, key)) is not None}
        answers = {f"{key}.answer": part.answer for key, part in parts.items()}
        answers |= {f"{key}.done": (part.done,) for key, part in parts.items() if isinstance(part, _Commands)}
        for key, texts in answers.items():
            for text in texts:
                self.line.require_received(key, text)
                if text and refusal_in(self.refusals, text) is not None:
                    raise ValueError(f"{key} = {text!r} is one of the refusals, too: another text was expected")
                if self.unasked_in(text) is not None:
                    raise ValueError(f"{key} = {text!r} is one of the unasked messages, too: another text was expected")
        others = {"refusals": self.refusals.all, "unasked": tuple(message.text for message in self.unasked)}
        for key, texts in others.items():
            for text in texts:
                self.line.require_received(key, text)
        return self

    def unasked_in(self, text: str) -> Unasked | None:
        """Return the first unasked message that a text is; None if it is none."""
        return next((message for message in self.unasked if value_in((message.text,), text) is not None), None)

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
    path, known = Path(named), built_in_languages()
    if not named.lower().endswith(FILE_ENDING):
        if named.lower() not in known:
            hint = f"{near} " if (near := nearest_names(named, known)) else ""
            raise ConfigurationError(
                f"no projector language {named!r}; {hint}expected {', '.join(known)}, "
                f"or the path of a file that ends with {FILE_ENDING}"
            )
        path = FOLDER / f"{named.lower()}{FILE_ENDING}"
    text = read_text(path, "write one as docs/devices.md describes", "language file")
    return parse_language(text, str(path))


def parse_language(text: str, where: str) -> Language:
    """Return the language in a TOML text; `where` names it in errors."""
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
    """Return the bytes of an answer; an empty one has no line of its own."""
    whole = line.answer.replace(_VALUE, text)
    return (whole if text else whole.lstrip("\r\n")).encode("ascii")


def answer_parser(language: Language, sent: str = "") -> MessageParser[str]:
    """Return what takes one answer, without its framing, off the front of the bytes.

    `sent`: the command before it, whose echo is passed over. If the echo and the answer are alike and only one of them
    comes, the prompt after it shows that it was the answer. An unended answer ends where an unasked message begins.
    """
    line = language.line
    ends = [character.encode("ascii") for character in line.ends]
    begin, prompt = line.answer.partition(_VALUE)[0].encode("ascii"), line.prompt.encode("ascii")

    def take(data: bytes) -> tuple[str, int] | None:
        place, echoed = 0, False
        while True:
            place = len(data) - len(data[place:].lstrip(_BLANK))
            if prompt and data.startswith(prompt, place):
                place += len(prompt)
                if echoed:
                    return sent, place
                continue
            place += len(begin) if data.startswith(begin, place) else 0
            found = [end for end in (data.find(character, place) for character in ends) if end >= 0]
            text = text_of(data[place : min(found, default=len(data))].strip(_BLANK))
            if not found:
                return (text, len(data)) if text in line.unended else None
            for word in line.unended:
                if text.startswith(word) and language.unasked_in(text.removeprefix(word).removeprefix(begin.decode())):
                    return word, data.index(word.encode("ascii"), place) + len(word)
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


Refusal = Literal["unknown", "busy", "unclear"]  # The kinds of `Refusals`


def refusal_in(refusals: Refusals, text: str) -> Refusal | None:
    """Return in which way an answer refuses; None if it does not."""
    return next((kind for kind in get_args(Refusal) if value_in(getattr(refusals, kind), text) is not None), None)
