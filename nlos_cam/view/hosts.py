"""Hosts: which address a name stands for, which names are this machine's, what an address is called in a browser."""

import ipaddress
import socket
from collections.abc import Callable

from nlos_cam.errors import NlosCamError

LOCAL_NAMES = {"localhost", "127.0.0.1", "::1"}
EVERYWHERE = {"0.0.0.0": "127.0.0.1", "::": "::1"}  # noqa: S104  looked up, not bound
"""What listens on every interface, and where a browser on this machine finds it."""


def resolved(host: str) -> tuple[socket.AddressFamily, str]:
    """The family and the address of a host to listen at. Raises NlosCamError for a name that stands for none."""
    try:
        found = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    except (OSError, UnicodeError) as error:
        raise NlosCamError(f"--view-host {host}: no such address ({error}): give one of this machine's") from error
    family, *_, address = found[0]
    return family, str(address[0])


def is_loopback(address: str) -> bool:
    """Whether only this machine reaches an address."""
    return ipaddress.ip_address(address.partition("%")[0]).is_loopback


def exposed(host: str, port: int) -> str:
    """What others than this machine's users see of what is served there, in one line; empty on the loopback.

    Raises NlosCamError for a name that stands for no address.
    """
    _, address = resolved(host)
    if is_loopback(address):
        return ""
    where = "any address of this machine" if address in EVERYWHERE else address
    return (
        f"anyone who can reach {where} at port {port} sees the bench's pictures and depth, unencrypted and without a "
        "password"
    )


def names_of(host: str, address: str) -> Callable[[str], bool]:
    """Whether a browser's Host header names this machine, or an address, which no other's name server can forge."""
    names = LOCAL_NAMES | {host.lower(), socket.gethostname().lower()}
    local_only = is_loopback(address)

    def known(header: str) -> bool:
        name = name_in(header)
        return name in LOCAL_NAMES if local_only else name in names or _is_address(name)

    return known


def name_in(header: str) -> str:
    """The host of a Host header, without its port: where a port is forwarded it is another."""
    name = header.strip().lower()
    if name.startswith("["):
        return name[1:].partition("]")[0]
    return name.rpartition(":")[0] if ":" in name else name


def address_of(host: str, port: int) -> str:
    """The URL by which a browser on this machine finds it."""
    host = EVERYWHERE.get(host, host)
    return f"http://[{host}]:{port}/" if ":" in host else f"http://{host}:{port}/"


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
