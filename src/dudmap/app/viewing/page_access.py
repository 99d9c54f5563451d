"""Access to a page: this machine, or clients with a secret address."""

import ipaddress
import re
import secrets
import socket
import sys
from collections.abc import Mapping
from typing import Any
from urllib.parse import urlsplit

from dudmap.errors import ConfigError

TOKEN_BYTES = 16
"""Random bytes of a generated token: 128 bit."""
POLICY_VIOLATION = 1008
"""Code with which a connection is closed (RFC 6455, section 7.4.1)."""


class PageAccess:
    """Decides who may see the page.

    - Without a token a connection must name the loopback, against DNS rebinding.
    - With a token the path must be the token.
    - The ``Origin`` must be this page, against other pages in the browser.

    Args:
        token: Secret; None generates one if ``host`` admits other machines.

    Attributes:
        token: The secret, empty if none is needed.

    Raises:
        ConfigError: The token has too few or invalid characters.
    """

    def __init__(self, host: str, port: int, token: str | None = None) -> None:
        if token is not None and not re.fullmatch(r"[A-Za-z0-9_-]{8,200}", token):
            raise ConfigError(
                f"the token has {len(token)} characters; expected 8 or more of letters, digits, - and _, or none to "
                "have one made"
            )
        self.host, self.port = host, port
        self.local = is_loopback(host)
        self.token = token or ("" if self.local else secrets.token_urlsafe(TOKEN_BYTES))

    @property
    def url(self) -> str:
        """Address to open; a query tells viser's page the token."""
        name = "localhost" if self.local else self.host
        if name in ("0.0.0.0", "::", ""):
            name = socket.gethostname()
        place = f"[{name}]:{self.port}" if ":" in name else f"{name}:{self.port}"
        return f"http://{place}" + (f"/?websocket=ws://{place}/{self.token}" if self.token else "")

    @property
    def notice(self) -> str:
        """Sentence on who can see the page."""
        if self.local:
            return "for this machine only"
        return f"on {self.host} for every machine that reaches it, with this address only; it is not encrypted"

    def allows(self, path: str, headers: Mapping[str, str]) -> bool:
        """Whether a connection may see the page."""
        host, origin = headers.get("Host", ""), headers.get("Origin")
        if origin is not None and urlsplit(origin).netloc != host:
            return False
        if self.token:
            given = urlsplit(path).path.strip("/")
            return secrets.compare_digest(given.encode(), self.token.encode())
        return is_loopback(urlsplit(f"//{host}").hostname or "")

    def guard(self, server: Any) -> None:  # noqa: ANN401 - viser.ViserServer, of an optional package
        """Close every forbidden connection to a viser server before anything is sent; blocks viser's relay."""
        connections = server._websock_server

        async def check(client: Any) -> None:  # noqa: ANN401 - viser.infra.WebsockClientConnection
            # viser runs this before it sends; any error here ends the connection without a message
            connection = connections._live_connections[client.client_id]
            if not self.allows(connection.request.path, connection.request.headers):
                await connection.close(POLICY_VIOLATION, "the address of this page has a secret part, which is wrong")

        connections.on_client_connect(check)
        connections.disconnect_all_clients()
        for message in [kind for kind in connections._incoming_handlers if kind.__name__.startswith("ShareUrl")]:
            connections.unregister_handler(message)


def is_loopback(host: str) -> bool:
    """Whether a name or address is this machine alone."""
    if host.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def port_problem(host: str, port: int) -> str:
    """Why a port cannot serve; empty if it can."""
    with socket.socket() as probe:
        if sys.platform != "win32":  # Windows would let two programs take one port
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            return error.strerror or str(error)
    return ""
