"""Server of viser that is reachable only from this machine."""

import contextlib
import functools
import http
import io
from collections.abc import Awaitable, Callable, Iterator
from urllib.parse import urlsplit

import viser
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from codrl_mj.boundary import Argument

HOST = "127.0.0.1"
_HOST_NAMES = (HOST, "localhost")
"""Host names of allowed requests. Others come from foreign pages, or from names that point to this
machine on purpose (DNS rebinding).
"""


_HEAD_HTML = b"""
<script>window.__VISER_EMBED_CONFIG__ =
{darkMode: matchMedia("(prefers-color-scheme: dark)").matches};</script>
<style>@media (max-width: 36em) {
[style*="max-height: 60%"] { max-height: 38% !important }
[style*="max-height: 60%"], [style*="max-height: 60%"] [style*="width: 20em"]
{ width: 100% !important }
}</style>"""
"""Dark theme if the browser prefers it; on a phone the panel is at the bottom and leaves the scene
visible.
"""


class LocalServer(viser.ViserServer):
    """Server on the loopback interface that answers only its own pages and shares nothing."""

    def __init__(self, port: int) -> None:
        """Start to listen at a port, or at the next free one if it is taken."""
        if not 0 <= port < 65536:
            raise ValueError(
                f"port = {port}: must be 0 to 65535; 8080 is the default, 0 any free port"
            )
        # viser prints a table of addresses.
        with (
            _check_requests(),
            contextlib.redirect_stdout(io.StringIO()),
        ):
            super().__init__(host=HOST, port=port, verbose=False)

    def request_share_url(self, verbose: bool = True) -> str | None:  # noqa: ARG002
        """Refuse to open a tunnel through viser's host, which a client may request."""
        return None


@contextlib.contextmanager
def _check_requests() -> Iterator[None]:
    """Make servers that start in the block refuse foreign requests, and add our head to the page.

    viser has no setting for either.
    """
    original = websockets.asyncio.server.serve

    @functools.wraps(original)
    def serve(
        handler: Callable[[ServerConnection], Awaitable[None]],
        *arguments: Argument,
        process_request: Argument = None,
        **options: Argument,
    ) -> websockets.asyncio.server.serve:
        def check_request(connection: ServerConnection, request: Request) -> Response | None:
            if not is_same_origin(request.headers):
                return Response(
                    http.HTTPStatus.FORBIDDEN, "Forbidden", Headers({"Content-Length": "0"}), b""
                )
            if request.path.partition("?")[0] != "/":
                return process_request(connection, request)
            # The page must arrive uncompressed, to insert text into it.
            request.headers.pop("Accept-Encoding", None)
            response = process_request(connection, request)
            # None means an upgrade to a web socket.
            if response is not None:
                response.body = response.body.replace(b"<head>", b"<head>" + _HEAD_HTML, 1)
                del response.headers["Content-Length"]
                response.headers["Content-Length"] = str(len(response.body))
            return response

        return original(handler, *arguments, process_request=check_request, **options)

    websockets.asyncio.server.serve = serve
    try:
        yield
    finally:
        websockets.asyncio.server.serve = original


def is_same_origin(headers: Headers) -> bool:
    """Return True if a request comes from this server's own page, or from no page at all."""
    host, origins = headers.get_all("Host"), headers.get_all("Origin")
    if len(host) != 1 or urlsplit(f"//{host[0]}").hostname not in _HOST_NAMES:
        return False
    return origins in ([], [f"http://{host[0]}"])
