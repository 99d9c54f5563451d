"""Who may see a served page: this machine, or whoever has the address with its token; nothing else is sent."""

import pytest
from typer.testing import CliRunner

from dudmap.app.viewing.page_access import PageAccess, is_loopback
from dudmap.cli import app
from dudmap.errors import ConfigError
from run_folders import write_run

TOKEN = "a-token-of-a-test"


@pytest.mark.parametrize(
    ("host", "alone"),
    [("127.0.0.1", True), ("localhost", True), ("::1", True), ("127.9.9.9", True), ("0.0.0.0", False), ("::", False),
     ("", False), ("192.168.0.5", False), ("robot", False), ("localhost.evil.org", False)],
)  # fmt: skip
def test_loopback(host, alone):
    assert is_loopback(host) is alone


def test_this_machine_needs_no_token():
    access = PageAccess("127.0.0.1", 8080)
    assert access.url == "http://localhost:8080"
    assert access.allows("/", {"Host": "localhost:8080"})
    assert access.allows("/", {"Host": "127.0.0.1:9000", "Origin": "http://127.0.0.1:9000"})
    assert access.allows("/", {"Host": "[::1]:8080"})
    assert "this machine only" in access.notice


def test_pages_from_elsewhere_in_the_same_browser_get_nothing():
    access = PageAccess("127.0.0.1", 8080)
    assert not access.allows("/", {"Host": "localhost:8080", "Origin": "https://evil.org"})
    assert not access.allows("/", {"Host": "localhost:8080", "Origin": "null"})
    assert not access.allows("/", {"Host": "evil.org:8080", "Origin": "http://evil.org:8080"})  # DNS rebinding
    assert not access.allows("/", {})
    shared = PageAccess("0.0.0.0", 8080, TOKEN)
    assert not shared.allows(f"/{TOKEN}", {"Host": "robot:8080", "Origin": "https://evil.org"})


def test_other_machines_need_the_token():
    access = PageAccess("0.0.0.0", 8080)
    assert len(access.token) >= 20
    assert PageAccess("0.0.0.0", 8080).token != access.token
    headers = {"Host": "robot:8080", "Origin": "http://robot:8080"}
    assert access.allows(f"/{access.token}", headers)
    for path in ("/", "", "/wrong", f"/{access.token}x", f"/x/{access.token}", f"/?token={access.token}", "/\u20ac"):
        assert not access.allows(path, headers)
    assert access.url.endswith(f"/{access.token}")
    assert PageAccess("robot", 80, TOKEN).url == f"http://robot:80/?websocket=ws://robot:80/{TOKEN}"


@pytest.mark.parametrize("token", ["", "short", "with/slash/and more", "a" * 300])
def test_bad_tokens_are_refused(token):
    with pytest.raises(ConfigError, match="the token has"):
        PageAccess("127.0.0.1", 8080, token)


def test_the_command_refuses_a_bad_token(tmp_path):
    pytest.importorskip("viser")
    done = CliRunner().invoke(app, ["view", str(write_run(tmp_path / "run")), "--token", "x"])
    assert done.exit_code == 1
    assert "the token has 1 characters" in done.stderr


# -- a real server -----------------------------------------------------------------------------------------------------


@pytest.fixture(params=["127.0.0.1", "0.0.0.0"])
def window(request, tmp_path):
    pytest.importorskip("viser")
    import socket

    from dudmap.app.viewing.live_view import open_run

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    made = open_run(write_run(tmp_path / "secret-name"), request.param, port)
    yield made
    made.stop()


def messages(window, path, origin=None):
    """What arrives in a second or until the server closes the connection, as a browser with viser's page asks."""
    import viser
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.client import connect

    port, received = window.access.port, []
    with connect(f"ws://127.0.0.1:{port}{path}", subprotocols=[f"viser-v{viser.__version__}"], origin=origin) as client:
        try:
            while True:
                received.append(client.recv(timeout=1))
        except TimeoutError:
            return received, None
        except ConnectionClosed as closed:
            return received, closed.rcvd.code if closed.rcvd else -1


def test_nothing_is_sent_without_the_token(window):
    allowed = f"/{window.access.token}"
    received, code = messages(window, allowed)
    assert code is None
    assert sum(map(len, received)) > 1000, "the run is shown to who may see it"
    refused = [("/", None), ("/wrong", None)] if window.access.token else []
    for path, origin in [*refused, (allowed, "https://evil.org")]:
        assert messages(window, path, origin) == ([], 1008)


@pytest.mark.parametrize(
    "path",
    ["/../../metrics.json", "/%2e%2e/%2e%2e/etc/passwd", "/..%5c..%5cx", "//etc/passwd", "/metrics.json", "/%00"],
)
def test_no_file_of_the_disk_can_be_read(window, path):
    import http.client

    connection = http.client.HTTPConnection("127.0.0.1", window.access.port, timeout=5)
    connection.putrequest("GET", path, skip_host=False)
    connection.endheaders()
    try:
        answer = connection.getresponse()
    except http.client.HTTPException:
        return
    body = answer.read()
    assert answer.status != 200
    assert b"root:" not in body
    assert b"secret-name" not in body


def test_the_page_itself_tells_nothing_of_the_run(window):
    import urllib.request

    with urllib.request.urlopen(f"http://127.0.0.1:{window.access.port}/", timeout=5) as answer:
        assert b"secret-name" not in answer.read()


def test_nobody_can_publish_the_page(window):
    kinds = [kind.__name__ for kind in window._server._websock_server._incoming_handlers]
    assert kinds
    assert not [name for name in kinds if name.startswith("ShareUrl")]
