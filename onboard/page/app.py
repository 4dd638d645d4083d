"""The page's requests: one page, its states and pictures, and commands; who may make them."""

import asyncio
import base64
import hashlib
import ipaddress
import json
import re
import secrets
import socket
from collections.abc import AsyncIterator
from importlib.resources import files
from typing import Any, Final

from starlette.applications import Starlette
from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, Response, StreamingResponse
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from groundsbot.onboard.errors import OnboardError
from groundsbot.onboard.page.hub import MOST_WATCHERS, Hub
from groundsbot.onboard.page.messages import PageSettings, command_of

MOST_BODY_BYTES: Final = 4096
_COOKIE_S: Final = 30 * 24 * 3600
_LOCAL_NAMES: Final = frozenset({"localhost"})
_HEADERS: Final = {
    "cache-control": "no-store",
    "cross-origin-resource-policy": "same-origin",
    "referrer-policy": "no-referrer",
    "x-content-type-options": "nosniff",
}
_ASSETS: Final = "groundsbot.onboard.page.assets"


def make_app(hub: Hub, settings: PageSettings) -> ASGIApp:
    """Return the application."""
    html = files(_ASSETS).joinpath("page.html").read_text(encoding="utf-8").replace("{robot}", settings.robot_id)
    policy = {"content-security-policy": _policy(html)}

    def page(_request: Request) -> Response:
        return HTMLResponse(html, headers=policy)

    async def states(_request: Request) -> Response:
        changed = hub.register()
        if changed is None:
            return _refusal(503, f"{MOST_WATCHERS} browsers watch already")
        return StreamingResponse(_events(hub, changed), media_type="text/event-stream")

    async def picture(_request: Request) -> Response:
        return Response(hub.picture[0], media_type="image/jpeg") if hub.picture else _refusal(404, "no picture yet")

    async def command(request: Request) -> Response:
        try:
            wanted = await _json_of(request)
            checked = command_of(0, wanted.get("command"), wanted.get("text"))
            refusal = await hub.command(checked.act, checked.text)
        except OnboardError as error:
            return _refusal(400, str(error))
        return JSONResponse({}) if not refusal else _refusal(409, refusal)

    routes = [
        Route("/", page, methods=["GET"]),
        Route("/states", states, methods=["GET"]),
        Route("/picture", picture, methods=["GET"]),
        Route("/command", command, methods=["POST"]),
    ]
    return Guard(Starlette(routes=routes), settings)


def _policy(html: str) -> str:
    """Return a policy under which nothing runs or loads but the page's own style, script, states and pictures."""
    hashes = {}
    for tag in ("style", "script"):
        (inside,) = re.findall(f"<{tag}>(.*?)</{tag}>", html, re.DOTALL)
        hashes[tag] = base64.b64encode(hashlib.sha256(inside.encode()).digest()).decode()
    return (
        f"default-src 'none'; style-src 'sha256-{hashes['style']}'; script-src 'sha256-{hashes['script']}'; "
        "img-src 'self' data:; connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )


async def _events(hub: Hub, changed: asyncio.Event) -> AsyncIterator[str]:
    async for state in hub.states(changed):
        yield f"data: {state}\n\n"


async def _json_of(request: Request) -> dict[str, Any]:
    """Return the object in the body of a request.

    Raises:
        OnboardError: it is too long or no object.
    """
    body = b""
    async for piece in request.stream():
        body += piece
        if len(body) > MOST_BODY_BYTES:
            raise OnboardError(f"a command has at most {MOST_BODY_BYTES} bytes")
    try:
        wanted = json.loads(body)
    except (ValueError, RecursionError):
        wanted = None
    if not isinstance(wanted, dict):
        raise OnboardError("a command is a JSON object")
    return wanted


def _refusal(status: int, text: str) -> Response:
    return JSONResponse({"error": text}, status, {"connection": "close"})


class Guard:
    """Application in front of another, which lets through only what the page itself asks for."""

    def __init__(self, app: ASGIApp, settings: PageSettings) -> None:
        self._app = app
        self._settings = settings
        self._cookie = f"groundsbot_{settings.robot_id}"  # browsers share cookies between ports
        name = socket.gethostname().lower()
        self._names = {settings.host.lower(), name, f"{name}.local"}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or answer it with a refusal."""
        request = Request(scope)
        refusal = self._refusal_of(request)
        cookie = f"{self._cookie}={self._settings.token}; Max-Age={_COOKIE_S}; Path=/; HttpOnly; SameSite=Strict"

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = [(name.encode(), text.encode()) for name, text in _HEADERS.items()]
                if refusal is None and "token" in request.query_params:
                    headers.append((b"set-cookie", cookie.encode()))
                message["headers"] = [*message["headers"], *headers]
            await send(message)

        app = self._app if refusal is None else refusal
        await app(scope, receive, send_with_headers)

    def _refusal_of(self, request: Request) -> Response | None:
        headers = request.headers
        if not self._is_own_name(headers.get("host", "")):
            return _refusal(403, "this is not the address at which the page is served")
        token = request.query_params.get("token") or request.cookies.get(self._cookie) or ""
        if not secrets.compare_digest(token.encode(), self._settings.token.encode()):
            return _refusal(403, "open the page with the whole address that the recorder printed")
        if request.method not in ("GET", "POST") or "upgrade" in headers:
            return _refusal(405, "only GET and POST")
        if _body_bytes(headers) > (MOST_BODY_BYTES if request.method == "POST" else 0):
            return _refusal(413, f"a command has at most {MOST_BODY_BYTES} bytes")
        if request.method == "POST" and not _is_same_origin(headers):
            return _refusal(403, "commands come from the page itself only")
        return None

    def _is_own_name(self, host: str) -> bool:
        """Return whether a Host header names this computer; a name that others gave it may come from anywhere."""
        name = re.sub(r":\d*$", "", host.lower()).strip("[]")
        try:
            address = ipaddress.ip_address(name)
        except ValueError:
            return name in (_LOCAL_NAMES if self._settings.is_local else self._names) or name == self._settings.host
        return address.is_loopback if self._settings.is_local else True


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
