"""Messages contain no secrets of addresses and no control characters."""

from __future__ import annotations

import pytest

from foundation.console import run
from foundation.errors import InputError, StorageError
from foundation.secret_texts import masked, masked_values, printable


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("ftp://lab:s3cret@store.example/t", "ftp://…@store.example/t"),
        ("ftp://s3cret@store.example", "ftp://…@store.example"),
        ("ftp://lab:s3@cret@store.example/t", "ftp://…@store.example/t"),
        ("simplecache::ftp://lab:s3cret@store/t", "simplecache::ftp://…@store/t"),
        ("ab://x:s3cret@y then cd://z:s3cret@w", "ab://…@y then cd://…@w"),
        ("https://s/a?sv=1&sig=s3cret%3D&sr=c", "https://s/a?sv=1&sig=…&sr=c"),
        ("https://s/a?X-Amz-Credential=s3cret&X-Amz-Date=1", "https://s/a?X-Amz-Credential=…&X-Amz-Date=1"),
        ("https://s/a?AWSAccessKeyId=s3cret", "https://s/a?AWSAccessKeyId=…"),
        ("https://s/a?access_token=s3cret#x", "https://s/a?access_token=…"),
        ("https://ntfy.example/lab?auth=s3cret", "https://ntfy.example/lab?auth=…"),
        ("s3://bucket/a@b/c", "s3://bucket/a@b/c"),
        ("mail a@b.example, key=3", "mail a@b.example, key=3"),
    ],
)
def test_masks_secrets_of_addresses(text: str, shown: str) -> None:
    assert masked(text).startswith(shown)
    assert "s3cret" not in masked(text)
    assert masked(masked(text)) == masked(text)


def test_masks_values_for_json() -> None:
    value = {"a": ["ftp://u:p@h/x", 3, None], "b": ("ftp://u:p@h/x",), "ftp://u:p@h": True}
    assert masked_values(value) == {"a": ["ftp://…@h/x", 3, None], "b": ["ftp://…@h/x"], "ftp://u:p@h": True}


@pytest.mark.parametrize("sign", ["\u2028", "\u202e", "\u2066", "\u2069", "\x9b", "\x7f"])
def test_escapes_control_characters(sign: str) -> None:
    assert printable(f"a{sign}b") == f"a{sign.encode('unicode_escape').decode()}b"


def test_masks_errors(capsys: pytest.CaptureFixture[str]) -> None:
    def fails() -> None:
        raise StorageError("cannot write ftp://lab:s3cret@h/x")

    assert str(InputError("no ftp://lab:s3cret@h/x")) == "no ftp://…@h/x"
    assert run(fails) == 5
    assert capsys.readouterr().err == "error: cannot write ftp://…@h/x\n"


def test_escapes_control_characters_in_errors(capsys: pytest.CaptureFixture[str]) -> None:
    def fails() -> None:
        raise InputError("no \x1b]0;title\x07\udcff.png")

    assert run(fails) == 2
    assert capsys.readouterr().err == "error: no \\x1b]0;title\\x07\\udcff.png\n"
    assert printable("two\nlines\tand a tab, ä €") == "two\nlines\tand a tab, ä €"
