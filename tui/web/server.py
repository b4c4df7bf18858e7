"""The server of the pages: which address shows what, and who may ask for it."""

from __future__ import annotations

import asyncio
import hmac
import json
import logging
import socket
from contextlib import asynccontextmanager
from dataclasses import dataclass
from http import HTTPStatus
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qsl, quote, urlencode, urlsplit

import uvicorn
from markupsafe import Markup
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.requests import Request
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
from tui.output.console import finite
from tui.output.results import averages_line, curves_csv
from tui.web.access import Access, TooManyAttemptsError, Visitor, server_key
from tui.web.chart import choice_of, numbers, picture
from tui.web.html import page
from tui.web.live import Live
from tui.web.months import Months
from tui.web.pages import about_test
from tui.web.tests import PAGE, NoSuchTestError, Tests, compared
from tui.wording.verdict_text import WORDS

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
    from concurrent.futures import Future
    from pathlib import Path
    from types import FrameType

    from starlette.types import ASGIApp, Message, Receive, Scope, Send

    from daq.bench.model import Bench
    from daq.bench.tables.unattended import Web
    from tui.application.controls import Controls
    from tui.application.state import State

_LOGGER = logging.getLogger(__name__)
PATIENCE = 10.0
"""Seconds for which a page waits for an estimate, before it says that it is being made."""
LARGEST_FORM = 1 << 14
"""Bytes."""
_LOOPBACK = frozenset({"localhost", "127.0.0.1", "[::1]"})
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
_OPEN = ("/login", "/static/")
"""Paths that need no right."""


@dataclass(frozen=True, slots=True)
class Place:
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
    place : Place
    """

    def __init__(self, app: ASGIApp, access: Access, place: Place) -> None:
        self._app, self._access, self._place = app, access, place

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer, or refuse."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        async def guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                given = {name for name, _ in message["headers"]}
                message["headers"] = [
                    *message["headers"],
                    *(
                        (name.encode(), value.encode())
                        for name, value in _HEADERS.items()
                        if name.encode() not in given
                    ),
                ]
            await send(message)

        request = Request(scope)
        refusal = self._foreign(request)
        if refusal is None:
            try:
                visitor = await self._visitor(request)
            except TooManyAttemptsError as error:
                refusal = _too_many(error)
            else:
                scope["state"]["visitor"] = visitor
                refusal = self._refused(request, visitor)
        await (self._app if refusal is None else refusal)(scope, receive, guarded)

    def _foreign(self, request: Request) -> Response | None:
        """Refuse what another site sends in the name of a visitor."""
        host = request.headers.get("host", "")
        name = host.rpartition(":")[0] if host.rpartition(":")[2].isdigit() else host
        # Where anybody on this computer may look, the names of other sites must not lead here.
        if self._access.is_open and name.lower() not in self._place.hosts:
            return Response(f"{name}: not a name of this server", HTTPStatus.MISDIRECTED_REQUEST)
        origin = request.headers.get("origin")
        if request.method == "POST" and origin is not None and urlsplit(origin).netloc != host:
            return Response("this form is of another site", HTTPStatus.FORBIDDEN)
        return None

    async def _visitor(self, request: Request) -> Visitor | None:
        kind, _, token = request.headers.get("authorization", "").partition(" ")
        if kind.lower() == "bearer":
            return self._access.by_token(client_of(request), token.strip())
        cookie = request.cookies.get(self._place.cookie, "")
        return self._access.by_cookie(cookie) or self._access.anybody

    def _refused(self, request: Request, visitor: Visitor | None) -> Response | None:
        path = request.url.path
        if visitor is not None or path.startswith(_OPEN):
            return None
        wants_page = "text/html" in request.headers.get("accept", "")
        if request.method == "GET" and wants_page and "authorization" not in request.headers:
            query = f"?{request.url.query}" if request.url.query else ""
            return _see(f"/login?{urlencode({'next': path + query})}")
        return Response("log in, or send a token", HTTPStatus.UNAUTHORIZED)


def client_of(request: Request) -> str:
    """Return the address that a request came from."""
    return "" if request.client is None else request.client.host


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
        self._access = Access(web, server_key(bench))
        self._live = Live(controls, status)
        self._tests = Tests(controls, lambda: self._live.followed)
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
        config = uvicorn.Config(
            "",
            host=web.address,
            port=web.port,
            log_config=None,
            access_log=False,
            server_header=False,
            proxy_headers=False,
            timeout_graceful_shutdown=3,
            ssl_certfile=web.certificate,
            ssl_keyfile=web.key,
        )
        listening = _bound(web.address, web.port)
        with listening:
            names = {*_LOOPBACK, *(name.lower() for name in web.hosts)}
            place = Place(
                web.address,
                listening.getsockname()[1],
                web.certificate is not None,
                frozenset(names),
            )
            config.app = self.application(place)
            server = _Uvicorn(config, self._live.end)
            ready(place.url)
            server.run(sockets=[listening])

    def application(self, place: Place) -> ASGIApp:
        """Return the application that answers requests."""
        self._place = place
        routes = [
            Route("/", self._now),
            Route("/events", self._events),
            Route("/now/curves", self._now_curves),
            Route("/tests", self._list),
            Route("/tests/{name}", self._test),
            Route("/tests/{name}/curves", self._test_curves),
            Route("/tests/{name}/report.html", self._report),
            Route("/tests/{name}/report.pdf", self._report),
            Route("/tests/{name}/result.json", self._json),
            Route("/tests/{name}/curves.csv", self._csv),
            Route("/tests/{name}/certificate/{number:int}", self._certificate),
            Route("/sensors", self._sensors),
            Route("/sensors.png", self._picture),
            Route("/archive", self._archive),
            Route("/archive/days.png", self._picture),
            Route("/archive/density.png", self._picture),
            Route("/login", self._log_in, methods=["GET", "POST"]),
            Route("/logout", self._log_out, methods=["POST"]),
            Route("/start", self._start, methods=["GET", "POST"]),
            Route("/stop", self._stop, methods=["GET", "POST"]),
            Route("/mark", self._mark, methods=["POST"]),
            Mount("/static", StaticFiles(packages=[("tui.web", "static")])),
        ]
        handlers: dict[Any, Any] = dict.fromkeys(
            (HuddleError, EstimatorError, HTTPException), self._failed
        )
        handlers[Exception] = self._broken
        made = Starlette(routes=routes, exception_handlers=handlers, lifespan=self._lifespan)
        return Guard(made, self._access, place)

    @asynccontextmanager
    async def _lifespan(self, app: Starlette) -> AsyncIterator[None]:
        del app
        yield
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
        code: int = HTTPStatus.INTERNAL_SERVER_ERROR
        text = str(error)
        if isinstance(error, NoSuchTestError):
            code = HTTPStatus.NOT_FOUND
        elif isinstance(error, HTTPException):
            code, text = error.status_code, error.detail
        return self._page(
            request, "message", code=code, title=HTTPStatus(code).phrase, text=text, refresh=0
        )

    async def _broken(self, request: Request, error: Exception) -> Response:
        _LOGGER.error("error in the page %s", request.url.path, exc_info=error)
        return self._page(
            request,
            "message",
            code=HTTPStatus.INTERNAL_SERVER_ERROR,
            title="Error",
            text="This is an error in huddle itself; its log has more. Please report it.",
            refresh=0,
        )

    async def _now(self, request: Request) -> Response:
        update = await self._live.latest()
        state, version = self._live.state, self._live.version
        about = await run_in_threadpool(_chart, state, request.query_params)
        return self._page(request, "now", title="Now", parts=update.parts, version=version, **about)

    async def _events(self, request: Request) -> Response:
        if request.method == "HEAD":
            return Response()
        return StreamingResponse(self._live.events(), media_type="text/event-stream")

    async def _now_curves(self, request: Request) -> Response:
        return await self._curves(self._live.state, request.query_params)

    async def _curves(self, state: State, asked: Mapping[str, str]) -> Response:
        try:
            found = await run_in_threadpool(lambda: numbers(state, choice_of(state, asked)))
        except (ValueError, OverflowError) as error:
            return Response(str(error), HTTPStatus.BAD_REQUEST)
        return _json(found)

    async def _list(self, request: Request) -> Response:
        asked = request.query_params
        first = int(asked.get("first", "0")) if asked.get("first", "0").isdecimal() else 0
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

    async def _state(self, request: Request) -> State | None:
        """Return the test that a request names, beside another one if it names two.

        None while an estimate is being made.
        """
        asked = [request.path_params["name"]]
        if other := request.query_params.get("with"):
            asked.append(other)
        futures = [self._tests.estimated(name) for name in asked]
        found = [await _waited(each) for each in futures]
        known = [each for each in found if each is not None]
        if len(known) < len(found):
            return None
        return known[0] if len(known) == 1 else compared(known[0], known[1])

    def _later(self, request: Request) -> Response:
        return self._page(
            request,
            "message",
            title="One moment",
            text="The estimate is being made. This page shows it as soon as it is there.",
            refresh=3,
        )

    async def _test(self, request: Request) -> Response:
        state = await self._state(request)
        if state is None:
            return self._later(request)
        about = await run_in_threadpool(_chart, state, request.query_params)
        document, certificates = await asyncio.wrap_future(
            self._tests.in_worker(
                lambda: (self._tests.document(state), self._tests.certificates(state))
            )
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
            base=f"/tests/{quote(name)}",
            averages=averages_line(state.snapshot) if state.snapshot is not None else "",
            certificates=certificates,
            others=others,
            other=request.query_params.get("with", ""),
        )

    async def _test_curves(self, request: Request) -> Response:
        state = await self._state(request)
        if state is None:
            return Response("the estimate is being made", HTTPStatus.SERVICE_UNAVAILABLE)
        return await self._curves(state, request.query_params)

    async def _report(self, request: Request) -> Response:
        state = await self._state(request)
        if state is None:
            return self._later(request)
        suffix = request.url.path[request.url.path.rindex(".") :]
        content = await asyncio.wrap_future(
            self._tests.in_worker(lambda: self._tests.report(state, suffix))
        )
        if suffix == ".pdf":
            return _download(content, "application/pdf", f"{state.name}.pdf")
        return HTMLResponse(content, headers={"content-security-policy": REPORT_POLICY})

    async def _json(self, request: Request) -> Response:
        state = await self._state(request)
        if state is None:
            return self._later(request)
        found = await asyncio.wrap_future(
            self._tests.in_worker(
                lambda: json.dumps(finite(self._tests.document(state)), ensure_ascii=False)
            )
        )
        return _download(found.encode(), "application/json", f"{state.name}.json")

    async def _csv(self, request: Request) -> Response:
        state = await self._state(request)
        if state is None or state.snapshot is None:
            return self._later(request)
        text = await run_in_threadpool(curves_csv, state.snapshot)
        return _download(text.encode(), "text/csv; charset=utf-8", f"{state.name}.csv")

    async def _certificate(self, request: Request) -> Response:
        state = await self._state(request)
        if state is None:
            return self._later(request)
        found = await asyncio.wrap_future(
            self._tests.in_worker(lambda: self._tests.certificates(state))
        )
        number = request.path_params["number"]
        if number >= len(found):
            raise NoSuchTestError("no such certificate")
        _, path = found[number]
        content = await run_in_threadpool(path.read_bytes)
        return _download(content, "application/pdf", path.name)

    async def _sensors(self, request: Request) -> Response:
        about = await asyncio.wrap_future(self._tests.in_worker(self._months.sensors))
        return self._page(request, "sensors", title="Sensors", **about)

    async def _archive(self, request: Request) -> Response:
        about = await asyncio.wrap_future(self._tests.in_worker(self._months.archive))
        return self._page(request, "archive", title="Archive", **about)

    async def _picture(self, request: Request) -> Response:
        name = request.url.path.rpartition("/")[2].removesuffix(".png")
        months = self._months

        def drawn() -> bytes:
            return months.sensors_picture() if name == "sensors" else months.archive_picture(name)

        try:
            content = await asyncio.wrap_future(self._tests.in_worker(drawn))
        except LookupError as error:
            raise HTTPException(HTTPStatus.NOT_FOUND, str(error)) from None
        return Response(content, media_type="image/png")

    # ------------------------------------------------------------------------- steering

    async def _log_in(self, request: Request) -> Response:
        form = await _form(request) if request.method == "POST" else {}
        after = form.get("next") or request.query_params.get("next", "/")
        after = after if after[:1] == "/" and after[1:2] not in {"/", "\\"} else "/"
        name = "".join(c for c in form.get("name", "") if c.isprintable()).strip()[:64]
        problem, code = "", HTTPStatus.OK
        if request.method == "POST" and name:
            client, given = client_of(request), form.get("secret", "")
            try:
                async with self._checking:
                    cookie = await run_in_threadpool(self._access.log_in, client, name, given)
            except TooManyAttemptsError as error:
                problem, code = str(error), HTTPStatus.TOO_MANY_REQUESTS
                headers = {"retry-after": str(error.seconds)}
                response = self._login_page(request, problem, code, name, after)
                response.headers.update(headers)
                return response
            if cookie is not None:
                _LOGGER.info("%s logged in from %s", name, client)
                response = _see(after)
                response.set_cookie(
                    self._place.cookie,
                    cookie,
                    httponly=True,
                    samesite="strict",
                    secure=self._place.is_secure
                    or request.headers.get("x-forwarded-proto") == "https",
                )
                return response
            _LOGGER.warning("wrong password for the pages from %s", client)
            problem, code = "This password or token is wrong.", HTTPStatus.FORBIDDEN
        return self._login_page(request, problem, code, name, after)

    def _login_page(
        self, request: Request, problem: str, code: int, name: str, after: str
    ) -> Response:
        return self._page(
            request, "login", code=code, title="Log in", problem=problem, name=name, next=after
        )

    async def _log_out(self, request: Request) -> Response:
        _check_form(request, await _form(request))
        response = _see("/")
        response.delete_cookie(self._place.cookie, httponly=True, samesite="strict")
        return response

    async def _steering(self, request: Request) -> tuple[Visitor, dict[str, str]]:
        """Return who steers, and the form; refuse others.

        Raises
        ------
        HTTPException
            If the visitor may not steer, or the form is not of these pages.
        """
        visitor: Visitor | None = request.state.visitor
        if visitor is None or not visitor.may_steer:
            raise HTTPException(HTTPStatus.FORBIDDEN, "This needs the right to start and stop.")
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


def _bound(address: str, port: int) -> socket.socket:
    """Return a listening socket.

    Raises
    ------
    OSError
        Naming address and port, if it cannot be had.
    """
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    try:
        return socket.create_server((address, port), family=family)
    except OSError as error:
        raise OSError(error.errno, error.strerror, f"{address} port {port}") from error


async def _waited(future: Future[State]) -> State | None:
    try:
        return await asyncio.wait_for(asyncio.shield(asyncio.wrap_future(future)), PATIENCE)
    except TimeoutError:
        return None


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


def _json(document: dict[str, Any]) -> Response:
    return Response(json.dumps(document, ensure_ascii=False), media_type="application/json")


def _download(content: bytes, kind: str, name: str) -> Response:
    named = f"attachment; filename*=UTF-8''{quote(name)}"
    return Response(content, media_type=kind, headers={"content-disposition": named})


async def _form(request: Request) -> dict[str, str]:
    """Return the fields of a form.

    Raises
    ------
    HTTPException
        If it is too large.
    """
    content = b""
    async for part in request.stream():
        content += part
        if len(content) > LARGEST_FORM:
            raise HTTPException(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, "The form is too large.")
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
    if not is_token and (not wanted or not hmac.compare_digest(form.get("token", ""), wanted)):
        raise HTTPException(HTTPStatus.FORBIDDEN, "Open the page again: this form is too old.")
