"""Access control of the studio: host names, origins, the token, and signed cookies that name visitors."""

from __future__ import annotations

import hashlib
import hmac
import secrets
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from urllib.parse import urlsplit

from fastapi import Request, Response
from fastapi.responses import RedirectResponse

MAX_BODY_BYTES = 256 * 1024  # Maximum size of a request (bytes).
MIN_TOKEN_CHARACTERS = 16
COOKIE, COOKIE_AGE_S = "studio", 24 * 3600
LOOPBACK = ("127.0.0.1", "localhost", "::1")
HEADERS = {
    "Content-Security-Policy": (
        "default-src 'self'; img-src 'self' data: blob:; style-src 'self' 'unsafe-inline'; object-src 'none';"
        " base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}


@dataclass(frozen=True)
class Gate:
    """Decides which requests are answered, and for which visitor.

    Only the studio issues visitor ids: a cookie holds the id, the time of issue and a signature. A visitor who invents
    an id has no session. In a studio with a token, only the address with the token leads to a cookie.

    Attributes:
        token: Token of the studio; "" means that everybody who reaches the studio may use it.
        hosts: Host names that requests may use; () means any. Without this check, a page of another origin could reach
            the studio through the host name of that origin.
        is_encrypted: Whether visitors use https, so cookies are not sent over http.
        clock: Function that returns the time (s since 1970).
        key: Key of the signatures. With a token, cookies stay valid when the studio restarts.
    """

    token: str = ""
    hosts: tuple[str, ...] = LOOPBACK
    is_encrypted: bool = False
    clock: Callable[[], float] = time.time
    key: bytes = field(default=b"", repr=False)

    def __post_init__(self) -> None:
        if self.token and len(self.token) < MIN_TOKEN_CHARACTERS:
            raise ValueError(
                f"the token of --token-file has {len(self.token)} characters; write at least {MIN_TOKEN_CHARACTERS}"
            )
        if not self.key:
            own = hashlib.sha256(b"cookies of the studio" + self.token.encode()).digest()
            object.__setattr__(self, "key", own if self.token else secrets.token_bytes(32))

    def refuse(self, request: Request) -> Response | None:
        """Return an error response if the form or the origin of a request is not allowed, otherwise None."""
        try:
            host = urlsplit(f"//{request.headers.get('host', '')}").hostname
        except ValueError:
            return Response("malformed host name", 400)
        if self.hosts and host not in self.hosts:
            return Response(
                "unknown host name; open the address that jobs/serve_studio.py printed, or name it in --host-names", 421
            )
        if request.method not in ("GET", "HEAD", "POST"):
            return Response("the studio answers GET and POST", 405, {"Allow": "GET, HEAD, POST"})
        # Pages of other origins cannot set a custom header.
        if request.method == "POST" and request.headers.get("x-studio") != "1":
            return Response("the request does not come from the page of the studio", 403)
        if "transfer-encoding" in request.headers:
            return Response("Transfer-Encoding is not accepted; send Content-Length", 411)
        length = request.headers.get("content-length", "0")
        if not length.isdecimal():
            return Response("malformed Content-Length", 400)
        if int(length) > MAX_BODY_BYTES:
            return Response(f"the request is larger than {MAX_BODY_BYTES:,} bytes", 413)
        return None

    def exchange_token(self, request: Request) -> Response | None:
        """Answer a request for the page with ?token=: a cookie and the address without the token, or an error.

        Returns None for all other requests.
        """
        if request.url.path != "/" or not self.token or "token" not in request.query_params:
            return None
        if not hmac.compare_digest(request.query_params["token"].encode(), self.token.encode()):
            return Response("wrong token; open the address that jobs/serve_studio.py printed", 401)
        response = RedirectResponse("/", 303)
        self.issue_cookie(response)
        return response

    def read_visitor(self, request: Request) -> str:
        """Return the id of the visitor, or "" if the request has no valid cookie."""
        name, _, rest = request.cookies.get(COOKIE, "").partition(".")
        issued, _, signature = rest.partition(".")
        if not (name and issued.isdecimal() and len(issued) < 16):
            return ""
        if not hmac.compare_digest(signature.encode(), self._sign(f"{name}.{issued}").encode()):
            return ""
        return name if 0 <= self.clock() - int(issued) <= COOKIE_AGE_S else ""

    def issue_cookie(self, response: Response) -> str:
        """Add a cookie with a new visitor id to a response, and return the id."""
        name = secrets.token_urlsafe(16)
        value = f"{name}.{int(self.clock())}"
        response.set_cookie(
            COOKIE,
            f"{value}.{self._sign(value)}",
            max_age=COOKIE_AGE_S,
            httponly=True,
            samesite="lax",  # With "strict", links from other pages would open the studio without the scene.
            secure=self.is_encrypted,
        )
        return name

    def _sign(self, value: str) -> str:
        return hmac.new(self.key, value.encode(), hashlib.sha256).hexdigest()
