"""The page: a small web server on one session, for browsers on this machine.

Each person has an address of their own, which holds a random token. Without it, from a foreign origin or under a
foreign host name nothing is answered, and nobody answers under the name of another. The page loads nothing from
elsewhere.
"""

import asyncio
import contextlib
import ipaddress
import json
import secrets
import socket
import threading
from collections.abc import AsyncIterator, Mapping
from importlib.resources import files

import uvicorn
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import PlainTextResponse, RedirectResponse, Response, StreamingResponse
from starlette.routing import Route
from starlette.types import ASGIApp, Receive, Scope, Send

from bayespbrl import checks
from bayespbrl.people.seat import Seat, Stale
from bayespbrl.people.session import Session, answer_of

LARGEST_BODY = 4096  # bytes
HEARTBEAT = 10.0  # seconds between signs of life; host.js misses them after SILENCE
EVERYWHERE = ("0.0.0.0", "::")  # hosts that stand for all addresses of this machine
FAREWELL = 1.5  # seconds for the last view to arrive
KINDS = {"front.js": "text/javascript", "host.js": "text/javascript", "front.css": "text/css"}
SHELL = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<title>Which one is better?</title>
<link rel="icon" href="data:,">
<link rel="stylesheet" href="front.css">
<style>body { margin: 0 } .bayespbrl { min-height: 100vh }</style>
</head>
<body><main id="front"></main><script type="module" src="host.js"></script></body>
</html>
"""
HEADERS = {
    "Cache-Control": "no-store",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; "
    "connect-src 'self'; img-src blob: data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
}


class Page:
    """A page on a free or given port, bound when this is made.

    Args:
      session: opened by `serve`.
      host: a name or address of this machine; by default only programs on it can connect.
      port: 0 for a free one.

    Raises:
      ValueError: a port that is in use, or an address that is not this machine's.
    """

    def __init__(self, session: Session, *, host: str = "127.0.0.1", port: int = 0):
        self.session = session
        self._seats = {secrets.token_urlsafe(16): seat for seat in session.seats}
        self.token = next(iter(self._seats))  # of the first or only person
        self._heard: dict[int, str | None] = {}  # the key of the answer to each turn
        if not 0 <= port <= 65535:
            raise ValueError(f"port: expected a number from 0 to 65535, got {port}")
        try:
            family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
            self._socket = socket.create_server((host, port), family=family)
        except (OSError, UnicodeError) as error:  # a name with an empty part
            raise ValueError(
                f"host, port: expected an address to listen on, got {host!r} and {port} ({error})"
            ) from error
        self.host, self.port = host, self._socket.getsockname()[1]
        config = uvicorn.Config(
            self._application(),
            log_level="warning",
            access_log=False,
            timeout_graceful_shutdown=1,
            lifespan="off",
            ws="none",
        )
        self._server = _Server(config)

    @property
    def address(self) -> str:
        """What the first or only person opens in a browser."""
        return self.addresses[0]

    @property
    def addresses(self) -> list[str]:
        """What each person opens in a browser."""
        host = _outward(self.host) if self.host in EVERYWHERE else self.host
        host = f"[{host}]" if ":" in host else host
        return [f"http://{host}:{self.port}/{token}/" for token in self._seats]

    def serve(self) -> None:
        """Answer requests until the session is over or `stop` is called; `KeyboardInterrupt` where the user stops it.

        Nothing is lost then.
        """
        self.session.open()
        farewell = threading.Thread(target=self._say_farewell, daemon=True)
        farewell.start()
        try:
            self._server.run(sockets=[self._socket])
        finally:
            self.session.close()
            self._socket.close()

    def stop(self) -> None:
        """End `serve`, from another thread."""
        self._server.should_exit = True

    def _say_farewell(self) -> None:
        self.session.wait(("finished", "failed"))
        threading.Event().wait(FAREWELL)
        self.stop()

    def _application(self) -> ASGIApp:
        routes = [
            Route("/", self._home),
            Route("/events", self._events),
            Route("/clip/{turn}/{side}", self._clip),
            Route("/answer", self._answer, methods=["POST"]),
            *(Route(f"/{name}", self._file) for name in KINDS),
        ]
        return Starlette(routes=routes, middleware=[Middleware(Guard, seats=self._seats, host=self.host)])

    async def _home(self, request: Request) -> Response:
        return Response(SHELL, media_type="text/html", headers=HEADERS)

    async def _file(self, request: Request) -> Response:
        name = request.url.path.rpartition("/")[2]
        content = files("bayespbrl.people").joinpath(name).read_text(encoding="utf-8")
        return Response(content, media_type=KINDS[name], headers=HEADERS)

    async def _clip(self, request: Request) -> Response:
        turn, side = request.path_params["turn"], request.path_params["side"]
        sheet = None
        with contextlib.suppress(ValueError):  # no number, one of too many digits, or of a turn that is over
            if turn.isascii() and turn.isdecimal():
                sheet = seat_of(request).sheet(int(turn), ("0", "1").index(side))
        if sheet is None:
            return PlainTextResponse("clip: expected one of the present question", 404)
        kind = "image/png" if sheet.startswith(b"\x89PNG") else "image/jpeg"
        return Response(sheet, media_type=kind, headers=HEADERS)

    async def _answer(self, request: Request) -> Response:
        try:
            body = await _bounded(request)
        except OverflowError:
            return PlainTextResponse(f"body: expected at most {LARGEST_BODY} bytes", 413)
        except ClientDisconnect:  # nobody hears what is said then
            return Response(status_code=400)
        try:
            message, key = answer_of(json.loads(body)), request.headers.get("idempotency-key")
            await asyncio.to_thread(self._take, seat_of(request), key, *message)
        except Stale as error:
            return PlainTextResponse(checks.one_line(error)[:300], 409)
        except (ValueError, RecursionError) as error:
            return PlainTextResponse(checks.one_line(error)[:300], 400)
        return Response(status_code=204)

    def _take(
        self, seat: Seat, key: str | None, turn: int, answer: str, seconds: float | None, replays: int | None
    ) -> None:
        """`Seat.answer`, once where the same message is sent again because its reply was lost."""
        with self.session.changed:
            if key is None or self._heard.get(turn) != key:
                seat.answer(turn, answer, seconds, replays)
                self._heard[turn] = key

    async def _events(self, request: Request) -> Response:
        return StreamingResponse(self._views(seat_of(request)), media_type="text/event-stream", headers=HEADERS)

    async def _views(self, seat: Seat) -> AsyncIterator[str]:
        """Each view of one person as a server-sent event, the present one first."""
        loop, changed = asyncio.get_running_loop(), asyncio.Event()

        def wake() -> None:
            with contextlib.suppress(RuntimeError):  # the server has just ended
                loop.call_soon_threadsafe(changed.set)

        deaf, sent = seat.listen(wake), None
        self._server.streams.add(changed)
        try:
            while not self._server.should_exit:
                changed.clear()
                view = seat.view
                yield "event: here\ndata: 1\n\n" if view is sent else f"data: {json.dumps(view)}\n\n"
                sent = view
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(changed.wait(), HEARTBEAT)
        finally:
            deaf()
            self._server.streams.discard(changed)


class _Server(uvicorn.Server):
    """Wakes the open event streams when it ends, so that they end by themselves."""

    def __init__(self, config: uvicorn.Config):
        super().__init__(config)
        self.streams: set[asyncio.Event] = set()

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        for changed in self.streams:
            changed.set()
        await super().shutdown(sockets)


def seat_of(request: Request) -> Seat:
    """The seat whose address was requested."""
    seat = request.scope["seat"]
    assert isinstance(seat, Seat)
    return seat


async def _bounded(request: Request) -> bytes:
    """The body; `OverflowError` where it is too long, without reading on."""
    body = b""
    async for part in request.stream():
        body += part
        if len(body) > LARGEST_BODY:
            raise OverflowError
    return body


class Guard:
    """Lets through what has a person's token as the first part of its path and comes from our own page."""

    def __init__(self, app: ASGIApp, *, seats: Mapping[str, Seat], host: str):
        self.app, self.seats, self.host = app, seats, host

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            return
        _, _, rest = scope["path"].partition("/")
        token, slash, path = rest.partition("/")
        headers = {name.decode("latin-1"): value.decode("latin-1") for name, value in scope["headers"]}
        known = [seat for own, seat in self.seats.items() if secrets.compare_digest(token.encode(), own.encode())]
        if known and not slash and scope["method"] == "GET" and self._ours(headers):  # typed without the last slash
            await RedirectResponse(f"/{token}/")(scope, receive, send)
            return
        if not (slash and known and self._ours(headers)):
            refusal = PlainTextResponse("expected the address that the program printed, with its token", 403)
            await refusal(scope, receive, send)
            return
        await self.app({**scope, "path": f"/{path}", "raw_path": f"/{path}".encode(), "seat": known[0]}, receive, send)

    def _ours(self, headers: dict[str, str]) -> bool:
        """Whether host and origin are this machine's. A foreign name may have been bent to our address."""
        host = headers.get("host", "")
        name = host.rpartition(":")[0] if host.rpartition(":")[2].isdigit() else host
        origin = headers.get("origin")
        return _is_address(name.strip("[]"), self.host) and origin in (None, f"http://{host}")


def _outward(host: str) -> str:
    """The address by which others reach this machine; its name where it is in no network."""
    family, there = (socket.AF_INET6, "2001:db8::1") if ":" in host else (socket.AF_INET, "192.0.2.1")
    with socket.socket(family, socket.SOCK_DGRAM) as probe, contextlib.suppress(OSError):
        probe.connect((there, 9))  # sends nothing; the address is one for documentation (RFC 5737, RFC 3849)
        return str(probe.getsockname()[0])
    return socket.gethostname()


def _is_address(name: str, host: str) -> bool:
    name, own = name.lower(), socket.gethostname().lower()  # browsers write names in lower case
    if name in ("localhost", host.lower(), own) or (host in EVERYWHERE and name == f"{own}.local"):
        return True
    try:
        address = ipaddress.ip_address(name)
    except ValueError:
        return False
    return address.is_loopback or host not in ("127.0.0.1", "localhost", "::1")
