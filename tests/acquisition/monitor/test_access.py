"""Who may look, and at what."""

from __future__ import annotations

import ipaddress
import socket

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acquisition.monitor.server import Access, Refusal, Request, is_loopback, reachable_addresses

OPEN = Access("", frozenset({"localhost"}))
CLOSED = Access("secret", frozenset({"localhost"}))


@pytest.mark.parametrize(
    ("target", "request_"),
    [
        ("/", Request("page")),
        ("/?", Request("page")),
        ("/state.json", Request("state")),
        ("/state.json?since=a.1.b&x=1", Request("state", since="a.1.b")),
        ("/frame/12.jpg?1", Request("frame", attempt=12)),
        ("/status.json", Request("status")),
    ],
)
def test_the_four_addresses(target: str, request_: Request) -> None:
    assert OPEN.judge(target, "localhost") == request_
    assert CLOSED.judge(f"/secret{target}", "localhost") == request_


@pytest.mark.parametrize("target", ["/frame/١.jpg", "/frame/1.jpg\n", "//[", "/%", "", "http://localhost/", "*"])
def test_what_is_no_address_is_refused(target: str) -> None:
    answer = OPEN.judge(target, "localhost")
    assert answer == Request("page") if target == "" else isinstance(answer, Refusal)


@given(st.text(max_size=40), st.text(max_size=20))
def test_without_the_token_nothing_is_shown(target: str, host: str) -> None:
    for asked in (target, f"/{target}", "/" + target.replace("secret", "")):
        assert isinstance(CLOSED.judge(asked, host), Refusal) or asked.startswith("/secret/")


@given(st.text(max_size=60))
def test_only_numbers_and_own_names_are_known(host: str) -> None:
    answer = OPEN.judge("/", host)
    if answer == Request("page"):
        name = host.lower().partition(":")[0] if not host.startswith("[") else host[1:].partition("]")[0]
        assert name == "localhost" or ipaddress.ip_address(name)


def test_a_token_is_asked_for_wherever_others_reach_it() -> None:
    assert Access.to("127.0.0.1").token == ""
    assert Access.to("localhost").token == ""
    assert Access.to("::1").token == ""
    for host in ("0.0.0.0", "::", "192.168.1.7", socket.gethostname() + ".example"):
        assert len(Access.to(host).token) >= 22
    assert not is_loopback("127.0.0.1.example")


def test_where_others_reach_it() -> None:
    assert reachable_addresses("192.168.1.7") == ("192.168.1.7",)
    assert reachable_addresses("fd00::7") == ("[fd00::7]",)
    assert reachable_addresses("lab.local") == ("lab.local",)
    assert all(name and "0.0.0.0" not in name for name in reachable_addresses("0.0.0.0"))


def test_without_a_network_it_goes_by_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    def unreachable(self: socket.socket, address: object) -> None:
        raise OSError("Network is unreachable")

    monkeypatch.setattr(socket.socket, "connect", unreachable)
    assert reachable_addresses("0.0.0.0") == (socket.gethostname(),)
