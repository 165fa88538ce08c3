"""viser's server, for this machine alone."""

import contextlib
import functools
import http
import io
from collections.abc import Iterator
from typing import Any
from urllib.parse import urlsplit

import viser
import websockets.asyncio.server
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

HOST = "127.0.0.1"
_NAMES = (HOST, "localhost")
"""As which a browser may ask for it: a page of somebody else's, or a name that was made to lead here, may not."""


_HEAD = b"""
<script>window.__VISER_EMBED_CONFIG__ = {darkMode: matchMedia("(prefers-color-scheme: dark)").matches};</script>
<style>@media (max-width: 36em) {
[style*="max-height: 60%"] { max-height: 38% !important }
[style*="max-height: 60%"], [style*="max-height: 60%"] [style*="width: 20em"] { width: 100% !important }
}</style>"""
"""Dark where the browser prefers it; on a phone the panel, at the bottom, leaves the scene in sight."""


class LocalServer(viser.ViserServer):
    """Listens on the loopback interface, answers pages of its own origin, and shares nothing through other hosts."""

    def __init__(self, port: int) -> None:
        """Begin to listen at a port or, where it is taken, the next free one."""
        if not 0 <= port < 65536:
            raise ValueError(
                f"port = {port}: must be 0 to 65535; 8080 is the default, 0 any that is free"
            )
        with (
            _checked_requests(),
            contextlib.redirect_stdout(io.StringIO()),
        ):  # viser prints a table of addresses
            super().__init__(host=HOST, port=port, verbose=False)

    def request_share_url(self, verbose: bool = True) -> str | None:  # noqa: ARG002
        """Refused: a client may ask for a tunnel to viser's host."""
        return None


@contextlib.contextmanager
def _checked_requests() -> Iterator[None]:
    """Let servers that begin in the block refuse requests of other origins, and give the page our head.

    viser has no setting for either.
    """
    plain = websockets.asyncio.server.serve

    @functools.wraps(plain)
    def serve(handler: Any, *arguments: Any, process_request: Any = None, **options: Any) -> Any:
        def checked(connection: Any, request: Request) -> Response | None:
            if not allowed(request.headers):
                return Response(
                    http.HTTPStatus.FORBIDDEN, "Forbidden", Headers({"Content-Length": "0"}), b""
                )
            if request.path.partition("?")[0] != "/":
                return process_request(connection, request)
            request.headers.pop("Accept-Encoding", None)  # text is to be put into the page
            response = process_request(connection, request)
            if response is not None:  # no upgrade to a web socket
                response.body = response.body.replace(b"<head>", b"<head>" + _HEAD, 1)
                del response.headers["Content-Length"]
                response.headers["Content-Length"] = str(len(response.body))
            return response

        return plain(handler, *arguments, process_request=checked, **options)

    websockets.asyncio.server.serve = serve  # type: ignore[assignment,misc]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = plain  # type: ignore[misc]


def allowed(headers: Any) -> bool:
    """Whether a request comes from this machine's browser for this very server, or from no page at all."""
    host, origins = headers.get_all("Host"), headers.get_all("Origin")
    if len(host) != 1 or urlsplit(f"//{host[0]}").hostname not in _NAMES:
        return False
    return origins in ([], [f"http://{host[0]}"])
