"""The page's requests: one page, its states and pictures, and commands."""

import asyncio
import json
import re
from collections.abc import AsyncIterator
from importlib.resources import files
from typing import Any, Final

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, Response, StreamingResponse
from starlette.routing import Route
from starlette.types import ASGIApp

from groundsbot.calib.web import Access, Guard, content_policy, hash_source, refusal
from groundsbot.onboard.errors import OnboardError
from groundsbot.onboard.page.hub import MOST_WATCHERS, Hub
from groundsbot.onboard.page.messages import command_of

MOST_BODY_BYTES: Final = 4096
_ASSETS: Final = "groundsbot.onboard.page.assets"


def make_app(hub: Hub, robot_id: str, access: Access) -> ASGIApp:
    """Return the application."""
    html = files(_ASSETS).joinpath("page.html").read_text(encoding="utf-8").replace("{robot}", robot_id)
    policy = {"content-security-policy": _policy(html)}

    def page(_request: Request) -> Response:
        return HTMLResponse(html, headers=policy)

    async def states(_request: Request) -> Response:
        changed = hub.register()
        if changed is None:
            return refusal(503, f"{MOST_WATCHERS} browsers watch already")
        return StreamingResponse(_events(hub, changed), media_type="text/event-stream")

    async def picture(_request: Request) -> Response:
        return Response(hub.picture[0], media_type="image/jpeg") if hub.picture else refusal(404, "no picture yet")

    async def command(request: Request) -> Response:
        try:
            wanted = await _json_of(request)
            checked = command_of(0, wanted.get("command"), wanted.get("text"))
            refused = await hub.command(checked.act, checked.text)
        except OnboardError as error:
            return refusal(400, str(error))
        return JSONResponse({}) if not refused else refusal(409, refused)

    routes = [
        Route("/", page, methods=["GET"]),
        Route("/states", states, methods=["GET"]),
        Route("/picture", picture, methods=["GET"]),
        Route("/command", command, methods=["POST"]),
    ]
    return Guard(Starlette(routes=routes), access, MOST_BODY_BYTES)


def _policy(html: str) -> str:
    """Return a policy under which nothing runs or loads but the page's own style, script, states and pictures."""
    style, script = (_inside(html, tag) for tag in ("style", "script"))
    return content_policy(hash_source(script), hash_source(style), "'self' data:")


def _inside(html: str, tag: str) -> str:
    (inside,) = re.findall(f"<{tag}>(.*?)</{tag}>", html, re.DOTALL)
    return str(inside)


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
