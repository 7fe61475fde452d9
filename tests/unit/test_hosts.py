import socket

import pytest

from nlos_cam.errors import NlosCamError
from nlos_cam.view.server import address_of, exposed, is_loopback, name_in, names_of, resolved

EVERYWHERE = "0.0.0.0"  # noqa: S104  looked up, not bound


@pytest.mark.parametrize(
    ("header", "name"),
    [
        ("localhost", "localhost"),
        ("LocalHost:9090", "localhost"),
        ("127.0.0.1:1", "127.0.0.1"),
        ("[::1]:9090", "::1"),
        ("[::1]", "::1"),
        ("", ""),
    ],
)
def test_a_host_headers_name_is_found_whatever_its_port(header: str, name: str) -> None:
    assert name_in(header) == name


def test_on_the_loopback_only_its_own_names_are_known() -> None:
    known = names_of("127.0.0.1", "127.0.0.1")
    assert all(map(known, ("localhost:9090", "127.0.0.1", "[::1]:80")))
    assert not any(map(known, ("bench.example", "10.0.0.1", socket.gethostname() + ".evil.example", "")))


def test_elsewhere_addresses_are_known_and_names_only_if_they_are_this_machines() -> None:
    known = names_of("bench.lan", "192.0.2.7")
    assert all(map(known, ("BENCH.lan:9090", "192.0.2.7:9090", "[fe80::1]:1", "localhost", socket.gethostname())))
    assert not any(map(known, ("evil.example", "bench.lan.evil.example", "")))


@pytest.mark.parametrize(("host", "loopback"), [("127.0.0.1", True), ("localhost", True), (EVERYWHERE, False)])
def test_a_host_is_resolved_and_is_the_loopback_or_not(host: str, loopback: bool) -> None:
    family, address = resolved(host)
    assert family in {socket.AF_INET, socket.AF_INET6}
    assert is_loopback(address) == loopback


@pytest.mark.parametrize("host", ["no such host", "." * 300])
def test_a_host_that_is_none_is_told(host: str) -> None:
    with pytest.raises(NlosCamError, match="no such address"):
        resolved(host)


def test_an_address_can_be_opened_on_this_machine() -> None:
    told = {host: address_of(host, 7) for host in ("127.0.0.1", EVERYWHERE, "::", "::1")}
    assert told == {
        "127.0.0.1": "http://127.0.0.1:7/",
        EVERYWHERE: "http://127.0.0.1:7/",
        "::": "http://[::1]:7/",
        "::1": "http://[::1]:7/",
    }


def test_what_others_see_is_told_where_they_can() -> None:
    assert exposed("127.0.0.1", 9090) == exposed("localhost", 9090) == ""
    assert "can reach any address of this machine at port 9090 sees" in exposed(EVERYWHERE, 9090)
    told = exposed("192.0.2.7", 8000)
    assert "192.0.2.7 at port 8000" in told
    assert "unencrypted and without a password" in told
    assert "\n" not in told
