"""The server of the pages: which address shows what, and who may ask for it.

Theory of operation
-------------------
`Guard` stands before the routes: it answers only to names of this server, finds out who asks, and
adds the headers that every answer has. `Server.routes` is the table of addresses, each with the
right that it needs; the endpoint of a route looks at that right itself, so that no spelling of an
address leads past it. What no route has is denied to who may not look.
"""

from __future__ import annotations

import asyncio
import json
import logging
import re
import socket
from collections import Counter
from contextlib import asynccontextmanager
from dataclasses import dataclass
from functools import partial
from http import HTTPStatus
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qsl, quote, urlencode, urlsplit

import uvicorn
from markupsafe import Markup
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import MutableHeaders, QueryParams
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import HTMLResponse, RedirectResponse, Response, StreamingResponse
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

from daq.bench.durations import format_duration, parse_duration
from daq.bench.end_condition import EndCondition
from daq.errors import HuddleError
from estimator.decision.verdict import Verdict
from estimator.errors import EstimatorError
from tui.application.plan import TestPlan
from tui.application.test_view.units import units_of
from tui.certificate.ledger import LedgerEntry, LedgerError
from tui.output.json_values import json_text
from tui.output.results import averages_line, curves_csv
from tui.web.access import (
    Access,
    Ended,
    Right,
    TooManyAttemptsError,
    Visitor,
    check_private,
    network_of,
    same,
    server_key,
    state_path,
)
from tui.web.chart import choice_of, numbers, picture
from tui.web.connections import Connections, most_connections
from tui.web.html import page
from tui.web.live import Live
from tui.web.months import Months
from tui.web.pages import about_test, how_sensors_stand
from tui.web.signal import Opened, SignalLook, drawn, steps
from tui.web.tests import PAGE, NoSuchTestError, Tests, compared, content_of, exclude_of
from tui.web.work import TooMuchWorkError, Work
from tui.wording.verdict_text import WORDS

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable, Hashable, Mapping
    from types import FrameType

    from starlette.types import ASGIApp, Message, Receive, Scope, Send

    from daq.bench.model import Bench
    from daq.bench.tables.unattended import Web
    from tui.application.controls import Controls
    from tui.application.state import State

_LOGGER = logging.getLogger(__name__)
PATIENCE = 10.0
"""Seconds for which a page waits for an estimate, before it says that it is being made."""
LEASE = 60.0
"""Seconds for which the estimate goes on, unless the page comes again."""
LARGEST_FORM, SLOWEST_FORM = 1 << 14, 10.0
"""Bytes, and seconds."""
STREAMS = 32
"""Running tests that one address may follow at the same time: half of its connections."""
_LOOPBACK = frozenset({"localhost", "127.0.0.1", "[::1]"})
_HOST = re.compile(r"(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9._-]+)(:\d{1,5})?")
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:;"
    " connect-src 'self'; form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
)
REPORT_POLICY = (
    "default-src 'none'; style-src 'unsafe-inline'; img-src data:; frame-ancestors 'none'; sandbox"
)
"""Reports have their styles inside, and no script."""
_HEADERS = {
    "content-security-policy": POLICY,
    "x-content-type-options": "nosniff",
    "referrer-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "cache-control": "no-store",
}
_HSTS = {"strict-transport-security": "max-age=31536000"}


class _LaterError(Exception):
    """What is asked for is being made: the page comes again."""


@dataclass(frozen=True, slots=True)
class WebPlace:
    """Where the server is reached."""

    address: str
    port: int
    is_secure: bool
    hosts: frozenset[str]

    @property
    def cookie(self) -> str:
        """Name of the cookie: those of all ports of a computer go to each of them."""
        return f"huddle-{self.port}"

    @property
    def url(self) -> str:
        """What people type."""
        host = f"[{self.address}]" if ":" in self.address else self.address
        return f"http{'s' * self.is_secure}://{host}:{self.port}/"


class Guard:
    """Looks who asks before anything else does, and closes every answer to other sites.

    Parameters
    ----------
    app : ASGI application
    access : Access
    place : WebPlace
    """

    def __init__(self, app: ASGIApp, access: Access, place: WebPlace) -> None:
        self._app, self._access, self._place = app, access, place

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer, or refuse."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        if scope["type"] != "http":
            raise ValueError(f"a connection of type {scope['type']}; expected http")
        added = _HEADERS | (_HSTS if scope["scheme"] == "https" else {})

        async def guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in added.items():
                    headers.setdefault(name, value)
            await send(message)

        request = Request(scope)
        refusal = self._foreign(request)
        if refusal is None:
            try:
                scope["state"]["visitor"] = self._visitor(request)
            except TooManyAttemptsError as error:
                refusal = _too_many(error)
        await (self._app if refusal is None else refusal)(scope, receive, guarded)

    def _foreign(self, request: Request) -> Response | None:
        """Refuse what is asked of another server, or sent by another site for a visitor."""
        host = request.headers.get("host", "")
        named = _HOST.fullmatch(host)
        if named is None:
            return Response("expected Host: name:port", HTTPStatus.BAD_REQUEST)
        name, (own, _) = named[1].lower(), request.scope.get("server") or ("", None)
        # A name of another site could lead here, and its pages could then read what is shown.
        if name not in self._place.hosts and name.strip("[]") != own:
            return Response(f"{name}: not a name of this server", HTTPStatus.MISDIRECTED_REQUEST)
        origin = request.headers.get("origin")
        if request.method == "POST" and origin is not None:
            try:
                other = urlsplit(origin).netloc != host
            except ValueError:
                return Response("expected Origin: http://name:port", HTTPStatus.BAD_REQUEST)
            if other:
                return Response("this form is of another site", HTTPStatus.FORBIDDEN)
        return None

    def _visitor(self, request: Request) -> Visitor | None:
        kind, _, token = request.headers.get("authorization", "").partition(" ")
        if kind.lower() == "bearer":
            return self._access.by_token(client_of(request), token.strip())
        cookie = request.cookies.get(self._place.cookie, "")
        return self._access.by_cookie(cookie) or self._access.anybody


def _refused(request: Request) -> Response:
    """Ask who may not look to log in."""
    wants_page = "text/html" in request.headers.get("accept", "")
    if request.method == "GET" and wants_page and "authorization" not in request.headers:
        asked = request.scope["query_string"].decode("latin-1")
        path = quote(request.scope["path"]) + (f"?{asked}" if asked else "")
        return _see(f"/login?{urlencode({'next': path})}")
    return Response("log in, or send a token", HTTPStatus.UNAUTHORIZED)


def client_of(request: Request) -> str:
    """Return the address that a request came from."""
    return "" if request.client is None else request.client.host[:64]


def _see(path: str) -> Response:
    return RedirectResponse(path, HTTPStatus.SEE_OTHER)


def _too_many(error: TooManyAttemptsError) -> Response:
    headers = {"retry-after": str(error.seconds)}
    return Response(str(error), HTTPStatus.TOO_MANY_REQUESTS, headers)


class Server:
    """The pages of one bench.

    Parameters
    ----------
    controls : Controls
        Start, stop, mark and find tests.
    bench : Bench
    web : Web
        The table of the bench file, with address and port as they are used.
    status : callable
        Returns what `tui.service.status.service_status` does.
    check : callable
        Makes the check list; returns what fails.
    """

    def __init__(
        self,
        controls: Controls,
        bench: Bench,
        web: Web,
        status: Callable[[], dict[str, Any]],
        check: Callable[[], Awaitable[str]],
    ) -> None:
        self._controls, self._bench, self._web = controls, bench, web
        self._check = check
        key = server_key(state_path(bench, "key"))
        self._access = Access(web, key, Ended(state_path(bench, "ended")))
        self._n_streams: Counter[str] = Counter()
        self._live = Live(controls, status)
        self._tests = Tests(controls, bench, lambda: self._live.followed)
        self._months = Months(bench)
        self._checking = asyncio.Lock()
        """Passwords are hashed one at a time: each takes a tenth of a second of a core."""

    def run(self, ready: Callable[[str], None]) -> None:
        """Serve until SIGINT or SIGTERM; `ready` takes the address. Blocks.

        Raises
        ------
        OSError
            If the port is taken, or a certificate cannot be read.
        """
        web = self._web
        if web.key is not None:
            check_private(Path(web.key), 0o007)
        self._connections = Connections(most_connections(), trusted=web.proxies)
        listening = self._connections.listening(web.address, web.port)
        with listening:
            names = {*_LOOPBACK, *(name.lower() for name in (*web.hosts, socket.gethostname()))}
            is_secure = web.certificate is not None
            place = WebPlace(web.address, listening.getsockname()[1], is_secure, frozenset(names))
            config = uvicorn.Config(
                self.application(place),
                loop="asyncio",
                http=self._connections.protocol(_HEADERS | (_HSTS if is_secure else {})),
                ws="none",
                log_config=None,
                log_level="error",
                access_log=False,
                server_header=False,
                proxy_headers=bool(web.proxies),
                forwarded_allow_ips=list(web.proxies),
                timeout_graceful_shutdown=3,
                ssl_certfile=web.certificate,
                ssl_keyfile=web.key,
            )
            server = _Uvicorn(config, self._live.end)
            ready(place.url)
            server.run(sockets=[listening])

    @property
    def routes(
        self,
    ) -> tuple[tuple[str, Right | None, Callable[[Request], Awaitable[Response]], str], ...]:
        """Every address: its path, the right that it needs (None: none), endpoint and methods."""
        read, steer, test = Right.READ, Right.STEER, "/tests/{name}"
        return (
            ("/", read, self._now, "GET"),
            ("/events", read, self._events, "GET"),
            ("/now/curves", read, self._now_curves, "GET"),
            ("/tests", read, self._list, "GET"),
            (test, read, self._test, "GET"),
            (f"{test}/curves", read, self._test_curves, "GET"),
            (f"{test}/signal", read, self._signal, "GET"),
            (f"{test}/signal/picture", read, self._signal_picture, "GET"),
            (f"{test}/report.html", read, self._report, "GET"),
            (f"{test}/report.pdf", read, self._report, "GET"),
            (f"{test}/result.json", read, self._json, "GET"),
            (f"{test}/curves.csv", read, self._csv, "GET"),
            (f"{test}/certificate/{{number}}", read, self._certificate, "GET"),
            ("/sensors", read, self._sensors, "GET"),
            ("/sensors.png", read, self._picture, "GET"),
            ("/archive", read, self._archive, "GET"),
            ("/archive/days.png", read, self._picture, "GET"),
            ("/archive/density.png", read, self._picture, "GET"),
            ("/login", None, self._log_in, "GET POST"),
            ("/logout", read, self._log_out, "POST"),
            ("/start", steer, self._start, "GET POST"),
            ("/stop", steer, self._stop, "GET POST"),
            ("/mark", steer, self._mark, "POST"),
        )

    def application(self, place: WebPlace) -> ASGIApp:
        """Return the application that answers requests."""
        self._place = place
        routes = [
            Route(path, _with_right(right, endpoint), methods=methods.split())
            for path, right, endpoint, methods in self.routes
        ]
        static = Mount("/static", StaticFiles(packages=[("tui.web", "static")]))
        every = Route(
            "/{path:path}", _with_right(Right.READ, self._nothing), methods=["GET", "POST"]
        )
        handlers: dict[Any, Any] = dict.fromkeys(
            (HuddleError, EstimatorError, HTTPException, OSError, ClientDisconnect), self._failed
        )
        handlers |= {_LaterError: self._later, Exception: self._broken}
        made = Starlette(
            routes=[*routes, static, every], exception_handlers=handlers, lifespan=self._lifespan
        )
        return Guard(made, self._access, place)

    async def _nothing(self, _request: Request) -> Response:
        raise HTTPException(HTTPStatus.NOT_FOUND, "There is no such page.")

    @asynccontextmanager
    async def _lifespan(self, app: Starlette) -> AsyncIterator[None]:
        del app
        watching = asyncio.create_task(self._connections.watch())
        yield
        watching.cancel()
        self._tests.close()
        await run_in_threadpool(self._live.close)

    # ------------------------------------------------------------------------- looking

    def _page(
        self,
        request: Request,
        template: str,
        *,
        code: int = HTTPStatus.OK,
        **values: Any,  # noqa: ANN401
    ) -> Response:
        visitor = getattr(request.state, "visitor", None)
        about = {
            "bench": self._bench.name,
            "visitor": visitor,
            "can_log_in": self._access.has_secrets,
        }
        return HTMLResponse(page(template, **about, **values), code)

    async def _failed(self, request: Request, error: Exception) -> Response:
        code: int = HTTPStatus.CONFLICT  # a file is not as it should be
        text = str(error)
        if isinstance(error, NoSuchTestError):
            code = HTTPStatus.NOT_FOUND
        elif isinstance(error, TooMuchWorkError):
            code = HTTPStatus.TOO_MANY_REQUESTS
        elif isinstance(error, HTTPException):
            code, text = error.status_code, error.detail
        return self._message(request, HTTPStatus(code).phrase, text, code)

    async def _broken(self, request: Request, error: Exception) -> Response:
        _LOGGER.error("error in the page %s", request.scope["path"], exc_info=error)
        text = "This is an error in huddle itself; its log has more. Please report it."
        return self._message(request, "Error", text, HTTPStatus.INTERNAL_SERVER_ERROR)

    def _message(
        self, request: Request, title: str, text: str, code: int, *, refresh: int = 0
    ) -> Response:
        return self._page(request, "message", code=code, title=title, text=text, refresh=refresh)

    async def _now(self, request: Request) -> Response:
        update = await self._live.latest()
        state, version = self._live.state, self._live.version
        about = await run_in_threadpool(_chart, state, request.query_params)
        return self._page(request, "now", title="Now", parts=update.parts, version=version, **about)

    async def _events(self, request: Request) -> Response:
        if request.method == "HEAD":
            return Response()
        client = network_of(client_of(request))
        if self._n_streams[client] >= STREAMS and client not in self._web.proxies:
            raise HTTPException(HTTPStatus.TOO_MANY_REQUESTS, "Too many pages are followed.")

        async def events() -> AsyncIterator[bytes]:
            self._n_streams[client] += 1
            try:
                async for each in self._live.events():
                    yield each
            finally:
                self._n_streams[client] -= 1
                self._n_streams += Counter()  # drops those that follow none any more

        return StreamingResponse(events(), media_type="text/event-stream")

    async def _now_curves(self, request: Request) -> Response:
        return await self._curves(self._live.state, request.query_params)

    async def _curves(self, state: State, asked: Mapping[str, str]) -> Response:
        try:
            found = await run_in_threadpool(lambda: numbers(state, choice_of(state, asked)))
        except (ValueError, OverflowError) as error:
            return Response(str(error), HTTPStatus.BAD_REQUEST)
        text = json.dumps(found, ensure_ascii=False)
        return Response(text, media_type="application/json")

    async def _list(self, request: Request) -> Response:
        asked = request.query_params
        first = _number(asked.get("first", "0"))
        text, verdict = asked.get("text", ""), asked.get("verdict", "")
        found = await run_in_threadpool(
            lambda: self._tests.listed(text=text, verdict=verdict, first=first)
        )
        verdicts = [("", "any"), *((each.value, WORDS[each]) for each in Verdict), ("none", "none")]
        return self._page(
            request,
            "tests",
            title="Tests",
            found=found,
            text=text,
            verdict=verdict,
            verdicts=verdicts,
            words=WORDS,
            first=first,
            size=PAGE,
        )

    async def _state(self, request: Request) -> State:
        """Return the test that a request names, beside another one if it names two.

        The first one without the stretches that the request leaves out.

        Raises
        ------
        HTTPException
            If one of these is no stretch of time.
        """
        try:
            exclude = exclude_of(request.query_params)
        except ValueError as error:
            raise HTTPException(HTTPStatus.BAD_REQUEST, str(error)) from None
        state = await self._estimated(request, request.path_params["name"], exclude)
        if other := request.query_params.get("with"):
            return compared(state, await self._estimated(request, other, None))
        return state

    async def _estimated(
        self, request: Request, name: str, exclude: tuple[str, ...] | None
    ) -> State:
        """Return a test without some stretches; None: those that its settings leave out."""
        key = await run_in_threadpool(self._tests.key_of, name)
        act = partial(self._tests.estimate, key[0], exclude)
        state: State = await self._made(request, self._tests.work, (key, exclude), act, PATIENCE)
        return state

    async def _made(
        self,
        request: Request,
        work: Work,
        key: Hashable,
        act: Callable[[], Any],
        patience: float | None = None,
    ) -> Any:  # noqa: ANN401 - whatever is made
        """Return what long work makes.

        Raises
        ------
        _LaterError
            If it takes longer than the patience (s).
        ClientDisconnect
            If the visitor leaves: work that nobody else wants is dropped.
        TooMuchWorkError
            If too much waits for this visitor.
        """
        visitor: Visitor = request.state.visitor
        piece = work.ask(visitor.number or network_of(client_of(request)), key, act)
        made = asyncio.wrap_future(piece.future)
        made.add_done_callback(lambda each: each.cancelled() or each.exception())
        gone = asyncio.create_task(_gone(request))
        lease = 0.0
        try:
            await asyncio.wait({made, gone}, timeout=patience, return_when=asyncio.FIRST_COMPLETED)
            if made.done():
                return made.result()
            if gone.done():
                raise ClientDisconnect
            lease = LEASE
            raise _LaterError
        finally:
            gone.cancel()
            work.leave(piece, lease=lease)

    async def _report_of(self, request: Request, kind: str) -> tuple[State, bytes]:
        """Return a test and its result as a file of a kind."""
        state = await self._state(request)
        key = await run_in_threadpool(self._tests.key_of, request.path_params["name"])
        act = partial(self._tests.report, state, kind)
        chosen = None if state.result is None else state.result.settings.exclude
        return state, await self._made(request, self._tests.work, (kind, key, chosen), act)

    async def _later(self, request: Request, _: Exception) -> Response:
        text = "The estimate is being made. This page shows it as soon as it is there."
        return self._message(request, "One moment", text, HTTPStatus.OK, refresh=3)

    async def _test(self, request: Request) -> Response:
        state = await self._state(request)
        about = await run_in_threadpool(_chart, state, request.query_params)

        def read() -> tuple[Any, ...]:
            standing = {} if state.result is None else how_sensors_stand(state.result)
            return self._tests.document(state), *self._certificates(state), standing

        document, certificates, problem, standing = await self._made(
            request, self._tests.reading, None, read
        )
        listed = await run_in_threadpool(self._tests.listed)
        name = request.path_params["name"]
        others = [
            each.path.name
            for each in listed.entries
            if each.path.name != name and not each.is_growing and not each.problem
        ]
        return self._page(
            request,
            "test",
            **about_test(state, document["settings"]),
            **about,
            **standing,
            base=f"/tests/{quote(name)}",
            averages=averages_line(state.snapshot) if state.snapshot is not None else "",
            certificates=certificates,
            problem=problem,
            others=others,
            other=request.query_params.get("with", ""),
            excluded=(chosen := request.query_params.getlist("exclude")),
            query="?" * bool(chosen) + urlencode([("exclude", each) for each in chosen]),
        )

    def _certificates(self, state: State) -> tuple[list[tuple[LedgerEntry, Path]], str]:
        """Return the certificates of a test, or why there are none to be trusted."""
        try:
            return self._tests.certificates(state), ""
        except LedgerError as error:
            return [], str(error)

    async def _test_curves(self, request: Request) -> Response:
        try:
            state = await self._state(request)
        except _LaterError:
            return Response("the estimate is being made", HTTPStatus.SERVICE_UNAVAILABLE)
        return await self._curves(state, request.query_params)

    async def _looked(self, request: Request, asked: QueryParams) -> dict[str, Any]:
        """Return what is asked to be seen of a recording against time.

        Raises
        ------
        ValueError
            If nothing of it is asked for.
        """
        key = await run_in_threadpool(self._tests.key_of, request.path_params["name"])
        act = partial(Opened.of, key[0])
        opened = await self._made(request, self._tests.work, ("signal", key), act, PATIENCE)
        look = SignalLook.of(opened, asked)
        snapshot = None
        if look.spectrum or look.exclude or look.is_changed or opened.settings.reject:
            name, chosen = request.path_params["name"], look.exclude if look.is_changed else None
            snapshot = (await self._estimated(request, name, chosen)).snapshot
        return await run_in_threadpool(drawn, opened, look, snapshot)

    async def _signal(self, request: Request) -> Response:
        problem, given = "", request.query_params
        kept = QueryParams([("exclude", each) for each in given.getlist("exclude")])
        for asked in (given, kept, QueryParams()):
            try:
                about = await self._looked(request, asked)
                break
            except (ValueError, OverflowError, IndexError) as error:
                problem = problem or str(error)
        name = request.path_params["name"]
        look = about["look"]
        return self._page(
            request,
            "signal",
            title=f"{name.removesuffix('.h5')}, signal",
            test=name.removesuffix(".h5"),
            base=f"/tests/{quote(name)}",
            steps=steps(look, about["whole"]),
            query="?" * look.is_changed + urlencode(look.query),
            problem=problem,
            **about,
        )

    async def _signal_picture(self, request: Request) -> Response:
        try:
            about = await self._looked(request, request.query_params)
        except (ValueError, OverflowError, IndexError) as error:
            return Response(str(error), HTTPStatus.BAD_REQUEST)
        except _LaterError:
            return Response("the recording is being read", HTTPStatus.SERVICE_UNAVAILABLE)
        return HTMLResponse(about["picture"])

    async def _report(self, request: Request) -> Response:
        suffix = ".pdf" if request.scope["path"].endswith(".pdf") else ".html"
        state, content = await self._report_of(request, suffix)
        if suffix == ".pdf":
            return _download(content, "application/pdf", f"{state.name}.pdf")
        return HTMLResponse(content, headers={"content-security-policy": REPORT_POLICY})

    async def _json(self, request: Request) -> Response:
        state = await self._state(request)
        found = await self._made(
            request, self._tests.reading, None, lambda: json_text(self._tests.document(state))
        )
        return _download(found.encode(), "application/json", f"{state.name}.json")

    async def _csv(self, request: Request) -> Response:
        state = await self._state(request)
        if state.snapshot is None:
            raise _LaterError
        text = await run_in_threadpool(curves_csv, state.snapshot)
        return _download(text.encode(), "text/csv; charset=utf-8", f"{state.name}.csv")

    async def _certificate(self, request: Request) -> Response:
        state = await self._state(request)
        act = partial(self._tests.certificates, state)
        found = await self._made(request, self._tests.reading, None, act)
        number = _number(request.path_params["number"], -1)
        if not 0 <= number < len(found):
            raise NoSuchTestError("no such certificate")
        _, path = found[number]
        content = await run_in_threadpool(content_of, path)
        return _download(content, "application/pdf", path.name)

    async def _sensors(self, request: Request) -> Response:
        about = await self._made(request, self._tests.work, None, self._months.sensors)
        return self._page(request, "sensors", title="Sensors", **about)

    async def _archive(self, request: Request) -> Response:
        about = await self._made(request, self._tests.work, None, self._months.archive)
        return self._page(request, "archive", title="Archive", **about)

    async def _picture(self, request: Request) -> Response:
        name = request.scope["path"].rpartition("/")[2].removesuffix(".png")
        months = self._months

        of_archive = partial(months.archive_picture, name)
        act = months.sensors_picture if name == "sensors" else of_archive
        try:
            content = await self._made(request, self._tests.work, None, act)
        except LookupError as error:
            raise HTTPException(HTTPStatus.NOT_FOUND, str(error)) from None
        return Response(content, media_type="image/png")

    # ------------------------------------------------------------------------- steering

    async def _log_in(self, request: Request) -> Response:
        form = await _form(request) if request.method == "POST" else {}
        after = form.get("next") or request.query_params.get("next", "/")
        after = after if after[:1] == "/" and after[1:2] not in {"/", "\\"} else "/"
        name = "".join(c for c in form.get("name", "") if c.isprintable()).strip()[:64]
        shown: dict[str, Any] = {"title": "Log in", "problem": "", "name": name, "next": after}
        if request.method == "GET" or not name:
            return self._page(request, "login", **shown)
        client, given = client_of(request), form.get("secret", "")
        try:
            async with self._checking:
                cookie = await run_in_threadpool(self._access.log_in, client, name, given)
        except TooManyAttemptsError as error:
            shown["problem"] = str(error)
            response = self._page(request, "login", code=HTTPStatus.TOO_MANY_REQUESTS, **shown)
            response.headers["retry-after"] = str(error.seconds)
            return response
        if cookie is None:
            _LOGGER.warning("wrong password for the pages from %s", client)
            shown["problem"] = "This password or token is wrong."
            return self._page(request, "login", code=HTTPStatus.FORBIDDEN, **shown)
        _LOGGER.info("%s logged in from %s", name, client)
        response, is_secure = _see(after), request.scope["scheme"] == "https"
        how: Any = {"httponly": True, "samesite": "strict", "secure": is_secure}
        response.set_cookie(self._place.cookie, cookie, **how)
        return response

    async def _log_out(self, request: Request) -> Response:
        _check_form(request, await _form(request))
        await run_in_threadpool(self._access.log_out, request.state.visitor)
        response = _see("/")
        response.delete_cookie(self._place.cookie, httponly=True, samesite="strict")
        return response

    async def _steering(self, request: Request) -> tuple[Visitor, dict[str, str]]:
        """Return who steers, and the form.

        Raises
        ------
        HTTPException
            If the form is not of these pages.
        """
        visitor: Visitor = request.state.visitor
        form = await _form(request) if request.method == "POST" else {}
        if request.method == "POST":
            _check_form(request, form)
        return visitor, form

    async def _act(self, request: Request, did: str, act: Callable[[], Path]) -> None:
        """Do something to a recording, and write who did it into the journal."""
        visitor: Visitor = request.state.visitor
        path = await run_in_threadpool(act)
        _LOGGER.info("%s (%s) %s %s in the browser", visitor.name, client_of(request), did, path)

    def _running(self) -> Path:
        path = self._live.followed or self._controls.find_running()
        if path is None:
            raise NoSuchTestError("no test is running")
        return path

    async def _start(self, request: Request) -> Response:
        visitor, form = await self._steering(request)
        kept = self._bench.recording.duration
        shown: dict[str, Any] = {"title": "Start a test", "action": "start", "test": ""}
        shown["duration"] = form.get("duration", "" if kept is None else format_duration(kept))
        if request.method == "GET":
            return self._page(request, "steer", **shown, problem="", may_confirm=False)
        is_confirmed = "anyway" in form
        by = f"started in the browser by {visitor.name} ({client_of(request)})"
        by += ", whatever the check list says" if is_confirmed else ""
        note = f"{form.get('text', '').strip()}; {by}".removeprefix("; ")
        failed = ""

        def start() -> Path:
            if self._controls.find_running() is not None:
                raise HuddleError("a test is running already")
            wanted = form.get("duration", "").strip()
            end = EndCondition(duration=parse_duration(wanted) if wanted else None)
            path = self._controls.start(TestPlan(form.get("operator") or None, note, end))
            self._controls.mark(path, note)
            return path

        if self._live.followed is None and not is_confirmed:
            failed = await self._check()
        problem = f"The check list fails: {failed}" if failed else ""
        if not failed:
            try:
                await self._act(request, "started", start)
            except (HuddleError, OSError, ValueError) as error:
                problem = str(error)
            else:
                return _see("/")
        return self._page(
            request,
            "steer",
            code=HTTPStatus.CONFLICT,
            **shown,
            problem=problem,
            may_confirm=bool(failed),
        )

    async def _stop(self, request: Request) -> Response:
        visitor, _ = await self._steering(request)
        if request.method == "GET":
            path = await run_in_threadpool(self._running)
            shown: dict[str, Any] = {"title": "Stop the test", "action": "stop", "test": path.stem}
            return self._page(request, "steer", **shown, duration="", problem="", may_confirm=False)
        by = f"stopped in the browser by {visitor.name} ({client_of(request)})"

        def stop() -> Path:
            path = self._running()
            self._controls.mark(path, by)
            self._controls.stop(path)
            return path

        await self._act(request, "stopped", stop)
        return _see("/")

    async def _mark(self, request: Request) -> Response:
        visitor, form = await self._steering(request)
        text = f"{form.get('text', '').strip()[:200]} ({visitor.name}, {client_of(request)})"

        def mark() -> Path:
            path = self._running()
            self._controls.mark(path, text)
            return path

        await self._act(request, "marked", mark)
        return _see("/")


class _Uvicorn(uvicorn.Server):
    """Ends what viewers wait for first: it would wait for them."""

    def __init__(self, config: uvicorn.Config, end: Callable[[], None]) -> None:
        super().__init__(config)
        self._end = end

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        self._end()
        super().handle_exit(sig, frame)


def _with_right(
    right: Right | None, endpoint: Callable[[Request], Awaitable[Response]]
) -> Callable[[Request], Awaitable[Response]]:
    """Return an endpoint that answers only to who has a right."""

    async def answer(request: Request) -> Response:
        visitor: Visitor | None = request.state.visitor
        if right is None:
            return await endpoint(request)
        if visitor is None:
            return _refused(request)
        if right is Right.STEER and not visitor.may_steer:
            raise HTTPException(HTTPStatus.FORBIDDEN, "This needs the right to start and stop.")
        return await endpoint(request)

    return answer


async def _gone(request: Request) -> None:
    """Return when the visitor has left."""
    while (await request.receive())["type"] != "http.disconnect":
        pass


def _number(text: str, otherwise: int = 0) -> int:
    """Return a whole number that an address has."""
    return int(text) if text.isascii() and text.isdecimal() and len(text) < 10 else otherwise


def _chart(state: State, asked: Mapping[str, str]) -> dict[str, Any]:
    """Return what the part of a page with curves shows."""
    try:
        choice = choice_of(state, asked)
    except (ValueError, OverflowError):
        choice = choice_of(state, {})
    snapshot = state.snapshot
    return {
        "choice": choice,
        "picture": Markup(picture(state, choice)),  # noqa: S704 - of a template that escapes
        "channels": [] if snapshot is None else [label.name for label in snapshot.channels],
        "units": [] if snapshot is None else [each.name for each in units_of(snapshot.unit)],
    }


def _download(content: bytes, kind: str, name: str) -> Response:
    named = f"attachment; filename*=UTF-8''{quote(name)}"
    return Response(content, media_type=kind, headers={"content-disposition": named})


async def _form(request: Request) -> dict[str, str]:
    """Return the fields of a form.

    Raises
    ------
    HTTPException
        If it is too large, or comes too slowly.
    """
    content = b""
    try:
        async with asyncio.timeout(SLOWEST_FORM):
            async for part in request.stream():
                content += part
                if len(content) > LARGEST_FORM:
                    code = HTTPStatus.REQUEST_ENTITY_TOO_LARGE
                    raise HTTPException(code, "The form is too large.")
    except TimeoutError:
        raise HTTPException(HTTPStatus.REQUEST_TIMEOUT, "The form came too slowly.") from None
    return dict(parse_qsl(content.decode("utf-8", "replace"), keep_blank_values=True))


def _check_form(request: Request, form: Mapping[str, str]) -> None:
    """Refuse a form that was not sent from these pages in this visit.

    Raises
    ------
    HTTPException
    """
    visitor: Visitor | None = request.state.visitor
    wanted = "" if visitor is None else visitor.form_token
    is_token = "authorization" in request.headers
    if not is_token and (not wanted or not same(form.get("token", ""), wanted)):
        raise HTTPException(HTTPStatus.FORBIDDEN, "Open the page again: this form is too old.")
