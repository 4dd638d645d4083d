"""Who may make requests of a page, and what a browser may do with its answers."""

import base64
import hashlib
import ipaddress
import re
import secrets
from typing import Final

from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from groundsbot.calib.web.endpoint import Access, own_names

_COOKIE_S: Final = 30 * 24 * 3600
_HEADERS: Final = {
    "cache-control": "no-store",
    "cross-origin-resource-policy": "same-origin",
    "referrer-policy": "no-referrer",
    "x-content-type-options": "nosniff",
}


class Guard:
    """Application in front of another, which lets through only what the page itself asks for."""

    def __init__(self, app: ASGIApp, access: Access, most_body_bytes: int = 0) -> None:
        """Guard an application.

        Args:
            app: the application.
            access: who may open the page.
            most_body_bytes: largest body of a POST request; 0: the page makes none.
        """
        self._app = app
        self._access = access
        self._most_body_bytes = most_body_bytes
        self._methods = ("GET", "POST") if most_body_bytes else ("GET",)
        self._cookie = f"groundsbot_{access.name}"
        self._names = {"localhost", access.host.lower()} | (set() if access.is_local else own_names())

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or answer it with a refusal."""
        request = Request(scope)
        refused = self._refusal_of(request)
        cookie = f"{self._cookie}={self._access.token}; Max-Age={_COOKIE_S}; Path=/; HttpOnly; SameSite=Strict"

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = [(name.encode(), text.encode()) for name, text in _HEADERS.items()]
                if refused is None and "token" in request.query_params:
                    headers.append((b"set-cookie", cookie.encode()))
                message["headers"] = [*message["headers"], *headers]
            await send(message)

        app = self._app if refused is None else refused
        await app(scope, receive, send_with_headers)

    def _refusal_of(self, request: Request) -> Response | None:
        headers = request.headers
        if not self._is_own_name(headers.get("host", "")):
            return refusal(403, "this is not the address at which the page is served")
        token = request.query_params.get("token") or request.cookies.get(self._cookie) or ""
        if not secrets.compare_digest(token.encode(), self._access.token.encode()):
            return refusal(403, "open the page with the whole address that the program printed")
        if request.method not in self._methods or "upgrade" in headers:
            return refusal(405, f"only {' and '.join(self._methods)}")
        if _body_bytes(headers) > (self._most_body_bytes if request.method == "POST" else 0):
            return refusal(413, f"a command has at most {self._most_body_bytes} bytes")
        if request.method == "POST" and not _is_same_origin(headers):
            return refusal(403, "commands come from the page itself only")
        return None

    def _is_own_name(self, host: str) -> bool:
        """Return whether a Host header names this computer; a name that others gave it may come from anywhere."""
        name = re.sub(r":\d*$", "", host.lower()).strip("[]")
        try:
            address = ipaddress.ip_address(name)
        except ValueError:
            return name in self._names
        return address.is_loopback if self._access.is_local else True


def refusal(status: int, text: str) -> Response:
    """Return an answer with a reason, after which the connection ends."""
    return JSONResponse({"error": text}, status, {"connection": "close"})


def content_policy(script: str, style: str, images: str) -> str:
    """Return a Content-Security-Policy under which nothing runs or loads but what is named, and the page's own data.

    Args:
        script: sources of scripts, as `hash_source` gives one.
        style: sources of styles.
        images: sources of images.
    """
    return (
        f"default-src 'none'; style-src {style}; script-src {script}; img-src {images}; connect-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )


def hash_source(text: str) -> str:
    """Return the source expression of an inline script or style, by its hash."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _is_same_origin(headers: Headers) -> bool:
    is_json = headers.get("content-type", "").partition(";")[0].strip().lower() == "application/json"
    is_own = headers.get("origin", "").lower() == f"http://{headers.get('host', '').lower()}"
    return is_json and is_own and headers.get("sec-fetch-site", "same-origin") == "same-origin"


def _body_bytes(headers: Headers) -> float:
    """Return the announced length of the body; that of one in pieces is not known and counted when it is read."""
    if "transfer-encoding" in headers:
        return 1
    length = headers.get("content-length", "0")
    return int(length) if length.isdecimal() and len(length) < 12 else float("inf")
