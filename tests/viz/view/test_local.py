"""Server of the live view: only this machine and its own pages have access, and it stays up."""

import asyncio
import http.client
import socket
import sys
import time

import msgspec
import pytest
import viser
import websockets

from codrl_mj.cli import main
from codrl_mj.viz.view.local import LocalServer


@pytest.fixture(scope="module")
def server():
    local_server = LocalServer(0)
    local_server.gui.add_markdown("hello")
    yield local_server
    local_server.stop()


def status(server, **headers):
    connection = http.client.HTTPConnection("127.0.0.1", server.get_port(), timeout=5)
    connection.putrequest("GET", "/", skip_host=True)
    for name, value in ({"Host": f"127.0.0.1:{server.get_port()}"} | headers).items():
        connection.putheader(name, value)
    connection.endheaders()
    return connection.getresponse().status


def connect(server, **options):
    port = server.get_port()
    return websockets.connect(
        f"ws://127.0.0.1:{port}",
        subprotocols=[f"viser-v{viser.__version__}"],
        max_size=None,
        **options,
    )


def test_it_is_reachable_only_from_this_machine(server):
    assert server.request_share_url() is None
    assert server.get_host() == "127.0.0.1"
    address = socket.gethostbyname(socket.gethostname())
    if not address.startswith("127."):
        with pytest.raises(OSError, match="refused"):
            socket.create_connection((address, server.get_port()), timeout=2)


def test_an_invalid_port_is_refused():
    with pytest.raises(ValueError, match="port = 65536: must be 0 to 65535"):
        LocalServer(65536)


def test_only_requests_of_its_own_pages_are_answered(server):
    port = server.get_port()
    assert status(server) == 200
    assert status(server, Host=f"localhost:{port}") == 200
    # A host name of an attacker that resolves to this machine.
    assert status(server, Host=f"evil.example:{port}") == 403
    assert status(server, Origin="http://evil.example") == 403
    assert status(server, Origin=f"http://127.0.0.1:{port}") == 200


@pytest.mark.parametrize(
    "origin", ["http://evil.example", "null", "http://127.0.0.1:1", "https://127.0.0.1:{port}"]
)
def test_foreign_pages_cannot_open_a_socket(server, origin):
    async def attempt():
        async with connect(server, origin=origin.format(port=server.get_port())):
            pass

    with pytest.raises(websockets.exceptions.InvalidStatus, match="403"):
        asyncio.run(attempt())


def test_malformed_messages_and_vanished_clients_do_no_harm(server):
    bad = [
        b"",
        b"\x00\xff\x13",
        b"\xc1",
        *map(msgspec.msgpack.encode, ({"type": "Nonsense"}, [1, 2])),
        "text",
    ]

    async def attempt():
        for message in bad:
            try:
                async with connect(server) as client:
                    await client.send(message)
                    await asyncio.sleep(0.05)
            except websockets.exceptions.ConnectionClosed:
                pass
        gone = await connect(server)
        # The client vanishes without closing the connection.
        gone.transport.abort()
        clients = [await connect(server) for _ in range(20)]
        first = [await asyncio.wait_for(client.recv(), 20) for client in clients]
        for client in clients:
            await client.close()
        return first

    first = asyncio.run(attempt())
    assert len(first) == 20
    assert all(first)
    ends = time.monotonic() + 10
    while server._websock_server._live_connections and time.monotonic() < ends:
        time.sleep(0.05)
    assert not server._websock_server._live_connections
    assert status(server) == 200


def test_without_the_extra_the_command_names_it(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "codrl_mj.viz.view.browser", None)
    monkeypatch.setitem(sys.modules, "viser", None)
    monkeypatch.delitem(sys.modules, "codrl_mj.viz.view.browser")
    assert main(["view", "cartpole"]) == 2
    assert "pip install 'codrl-mj[view]'" in capsys.readouterr().err


def test_native_without_a_display_is_refused(monkeypatch, capsys):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert main(["view", "cartpole", "--native"]) == 2
    assert "needs a display" in capsys.readouterr().err
