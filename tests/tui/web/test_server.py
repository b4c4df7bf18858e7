"""The pages as any program sees them: who may, what they hold, and that nothing of a test acts."""

from __future__ import annotations

import contextlib
import html
import http.client
import ipaddress
import json
import os
import re
import signal
import socket
import ssl
import subprocess
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path
from urllib.parse import urlencode, urlsplit

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from typer.testing import CliRunner

from daq.bench.tables.unattended import Web
from daq.recording.reader import Recording
from daq.results.result import Result
from tests.command import huddle
from tests.daq.results.decision.benches import bench_with
from tests.tui.example_snapshot import SETTINGS, diagnosed, made_snapshot
from tests.tui.night_recording import HOSTILE
from tests.tui.report.written_report import assert_as_kept, lines_of
from tests.tui.web.pages import READER, SECRETS, STEERER, Server, Visit, bench_file, serving
from tests.waiting import limit, wait_until
from tui.application.state import State
from tui.commands.main import app
from tui.page.blocks import Items, Section
from tui.page.table import Table
from tui.web.access import SHORTEST_TOKEN, Access, AccessError, Ended, token_hash
from tui.web.chart import choice_of, picture
from tui.web.pages import about_test
from tui.web.tests import compared

SERVICE = """
[[schedule]]
at = 2099-01-01T00:00:00Z
duration = "3h"
[web]
port = {port}
"""
HEADERS = {
    "x-content-type-options": "nosniff",
    "referrer-policy": "same-origin",
    "cache-control": "no-store",
}


@pytest.mark.parametrize(
    "path", ["/", "/tests", "/tests/night.h5", "/login", "/nothing", "/tests/night.h5/curves"]
)
def test_every_answer_has_a_strict_policy(server: Server, path: str) -> None:
    found = server.visit().get(path).headers
    assert {name: found[name] for name in HEADERS} == HEADERS
    policy = found["content-security-policy"]
    assert "default-src 'none'; script-src 'self'; style-src 'self'" in policy
    assert "unsafe" not in policy


def test_the_report_may_run_no_script(server: Server) -> None:
    found = server.visit().get("/tests/night.h5/report.html")
    assert found.status == 200
    policy = found.headers["content-security-policy"]
    assert "sandbox" in policy
    assert "script-src" not in policy
    assert "default-src 'none'" in policy


@pytest.mark.parametrize("path", ["/", "/tests", "/tests/night.h5", "/tests?text=<script>"])
def test_no_text_of_a_recording_reaches_a_page_unescaped(server: Server, path: str) -> None:
    text = server.visit().get(path).text
    scripts = re.findall(r"<script[^>]*>", text)
    assert all(re.fullmatch(r'<script src="/static/[\w.]+" defer>', each) for each in scripts)
    assert "<b>" not in text
    assert "cellar &lt;b&gt;" in text
    assert "49" not in re.findall(r"\{\{.*?\}\}", text)
    if path == "/tests/night.h5":
        assert html.escape(HOSTILE, quote=False).replace("'", "&#39;") in text


def test_a_test_has_verdict_table_picture_facts_and_settings(server: Server) -> None:
    text = server.visit().get("/tests/night.h5").text
    assert "NOT DECIDED: 1 of 8 channels may be above data sheet." in text
    assert re.search(r'<th scope="row">A\.X</th><td class="number"[^>]*>−97\.\d\d (±|\+)0', text)
    (gaps,) = re.findall(r'scope="row">B\.X</th>.*?<td class="number"[^>]*>(\d+)</td></tr>', text)
    assert gaps == "2"
    assert 'role="img" aria-label="A X   power spectral density' in text
    assert len(re.findall(r'<path d="M[^"]+" fill="none"', text)) == 5  # data, models, limit, noise
    assert "B: 2 gaps, 131 samples missing" in text
    assert 'aria-label="B: turned 0.0°"' in text
    assert "Coherence of pairs, mean over 2–20 Hz" in text
    assert '<th scope="row">segment</th><td data-title="value">1.0</td>' in text


def test_the_downloads_are_those_of_the_command(server: Server, folder: Path) -> None:
    recording = folder / "recordings" / "night.h5"
    asked = ("--json", str(folder / "night.json"), "--csv", str(folder / "night.csv"))
    CliRunner().invoke(app, ["estimate", str(recording), *asked])
    visit = server.visit()
    found = visit.get("/tests/night.h5/result.json")
    assert found.headers["content-disposition"] == "attachment; filename*=UTF-8''night.json"
    assert json.loads(found.content) == json.loads((folder / "night.json").read_text())
    curves = visit.get("/tests/night.h5/curves.csv").content
    assert curves == (folder / "night.csv").read_bytes()
    assert visit.get("/tests/night.h5/report.pdf").content.startswith(b"%PDF-")


def test_certificates_of_a_test_are_read(server: Server, folder: Path) -> None:
    recording = folder / "recordings" / "night.h5"
    assert "Certificate" not in server.visit().get("/tests/night.h5").text
    with Recording.open(recording) as opened:
        text = opened.bench_text.replace("sensitivity = 1e6", "sensitivity = 1e6, tolerance = 0.02")
    bench = folder / "stated.toml"
    bench.write_text(text, encoding="utf-8")
    issue = ("issue", str(recording), "--by", "Ada", "--allow-incomplete", "--bench", str(bench))
    CliRunner().invoke(app, [*issue, "--despite", "a test"])
    (issued,) = (folder / "recordings" / "certificates").glob("*.pdf")
    visit = server.visit()
    assert re.search(
        r'href="/tests/night\.h5/certificate/0">Certificate \S+-0001, revision 0<',
        visit.get("/tests/night.h5").text,
    )
    assert visit.get("/tests/night.h5/certificate/0").content == issued.read_bytes()
    assert visit.get("/tests/night.h5/certificate/1").status == 404


def test_pages_are_served_over_tls(tmp_path: Path) -> None:
    certificate, key = _self_signed(tmp_path)
    table = f'[web]\ncertificate = "{certificate}"\nkey = "{key}"\nsteer = "{token_hash(READER)}"\n'
    with serving(bench_file(tmp_path, table)) as found:
        assert found.url.startswith("https://127.0.0.1:")
        trusted = ssl.create_default_context(cafile=str(certificate))
        place = urlsplit(found.url)
        connection = http.client.HTTPSConnection(place.netloc, timeout=limit(60), context=trusted)
        with contextlib.closing(connection):
            form = urlencode({"name": "Ada", "secret": READER})
            connection.request("POST", "/login", form)
            answer = connection.getresponse()
            assert answer.status == 303
            assert "Secure" in str(answer.getheader("set-cookie"))
            assert answer.getheader("strict-transport-security") == "max-age=31536000"


def test_a_key_that_others_may_read_is_refused(tmp_path: Path) -> None:
    certificate, key = _self_signed(tmp_path)
    key.chmod(0o644)
    table = f'[web]\ncertificate = "{certificate}"\nkey = "{key}"\n'
    ended = CliRunner().invoke(app, ["web", str(bench_file(tmp_path, table)), "--port", "0"])
    assert ended.exit_code != 0
    assert "bench.key: others may read it (mode 0004); expected chmod 600" in ended.stderr


def _self_signed(folder: Path) -> tuple[Path, Path]:
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "bench")])
    now = datetime.now(UTC)
    made = (
        x509.CertificateBuilder(name, name, key.public_key(), x509.random_serial_number())
        .not_valid_before(now - timedelta(days=1))
        .not_valid_after(now + timedelta(days=1))
        .add_extension(
            x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address("127.0.0.1"))]),
            critical=False,
        )
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .sign(key, hashes.SHA256())
    )
    pem = serialization.Encoding.PEM
    certificate, private = folder / "bench.pem", folder / "bench.key"
    certificate.write_bytes(made.public_bytes(pem))
    private.write_bytes(
        key.private_bytes(pem, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    )
    private.chmod(0o600)
    return certificate, private


def test_curves_are_finer_where_less_is_shown(server: Server) -> None:
    visit = server.visit()
    whole = json.loads(visit.get("/tests/night.h5/curves?channel=2").content)
    assert whole["title"].startswith("B X")
    part = json.loads(visit.get("/tests/night.h5/curves?channel=2&from=10&to=20").content)
    noise = part["curves"][-1]
    assert all(9.9 <= each <= 20.1 for each in noise["frequency"])
    of_whole = sum(9.9 <= each <= 20.1 for each in whole["curves"][-1]["frequency"])
    assert len(noise["frequency"]) >= of_whole
    assert re.fullmatch(r"−\d+\.\d \(−\d+\.\d to −\d+\.\d\)", noise["words"][0])
    for wrong in ("channel=99", "channel=x", "unit=9", "from=20&to=10", "from=nan&to=1"):
        assert visit.get(f"/tests/night.h5/curves?{wrong}").status == 400


@pytest.mark.parametrize(
    "name", ["..%2Fcellar.toml", "..%2f..%2fetc%2fpasswd", "cellar.toml", "runs.sqlite", "%00"]
)
def test_only_recordings_of_the_bench_are_shown(server: Server, name: str) -> None:
    found = server.visit().get(f"/tests/{name}")
    assert found.status == 404
    assert b"sampling_rate = " not in found.content


def test_another_name_does_not_lead_to_an_open_server(server: Server) -> None:
    assert server.visit().get("/tests", Host="evil.example").status == 421
    assert server.visit().get("/tests", Host="evil.example:80").status == 421


def test_nobody_steers_an_open_server(server: Server) -> None:
    for path in ("/start", "/stop", "/mark"):
        found = server.visit().post(path, {"token": ""})
        assert found.status == 403
    assert "/start" not in server.visit().get("/").text


def test_an_address_that_others_reach_needs_a_secret(folder: Path) -> None:
    ended = huddle("web", bench_file(folder), "--address", "0.0.0.0", code=2)  # noqa: S104
    assert "address 0.0.0.0: other computers reach it; expected read =" in ended.stderr


@pytest.mark.parametrize("path", ["/", "/tests", "/events", "/tests/night.h5/result.json"])
def test_without_a_secret_nothing_is_seen(closed: Server, path: str) -> None:
    found = closed.visit().get(path)
    assert found.status == 303
    assert found.headers["location"].startswith("/login?next=")
    assert closed.visit().get(path, Accept="application/json").status == 401
    assert closed.visit().get(path, Cookie="huddle-0=e30.00").status == 303


def test_who_looks_does_not_steer(closed: Server) -> None:
    visit = closed.visit()
    answer = visit.log_in(READER)
    assert (answer.status, answer.headers["location"]) == (303, "/tests")
    assert {"HttpOnly", "SameSite=strict"} <= set(answer.headers["set-cookie"].split("; "))
    page = visit.get("/").text
    assert "Ada, may look" in page
    assert visit.get("/start").status == 403
    (token,) = set(re.findall(r'name="token" value="(\w+)"', page))
    assert visit.post("/stop", {"token": token}).status == 403


def test_forms_of_other_sites_do_nothing(closed: Server) -> None:
    visit = closed.visit(STEERER)
    (token,) = set(re.findall(r'name="token" value="(\w+)"', visit.get("/start").text))
    for form in ({}, {"token": ""}, {"token": token[:-1] + "x"}, {"token": "٣"}):
        assert visit.post("/mark", form | {"text": "x"}).status == 403
    wrong = visit.post("/mark", {"token": token, "text": "x"}, Origin="https://evil.example")
    assert wrong.status == 403
    right = visit.post("/mark", {"token": token, "text": "x"}, Origin=closed.url.rstrip("/"))
    assert (right.status, "no test is running" in right.text) == (404, True)
    other = closed.visit(STEERER, name="Bob")
    assert other.post("/mark", {"token": token, "text": "x"}).status == 403


def test_a_test_that_fails_its_check_list_waits_for_a_confirmation(closed: Server) -> None:
    visit = closed.visit(STEERER)
    (token,) = set(re.findall(r'name="token" value="(\w+)"', visit.get("/start").text))
    found = visit.post("/start", {"token": token, "duration": "1h"})
    assert found.status == 409
    assert re.search(r"The check list fails: .*/dev/ttyA", found.text), found.text
    assert 'type="checkbox" name="anyway" required' in found.text
    assert 'value="1h"' in found.text


def test_programs_send_a_token(closed: Server) -> None:
    found = closed.visit().get("/tests/night.h5/result.json", Authorization=f"Bearer {READER}")
    assert json.loads(found.content)["verdict"] == "not-decided"
    assert closed.visit().get("/tests", Authorization=f"Bearer {STEERER}").status == 401


def test_a_token_may_be_in_the_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    web, ended = Web(read="${HUDDLE_TOKEN_OF_A_TEST}"), Ended(tmp_path / "ended")
    token = "t" * SHORTEST_TOKEN
    monkeypatch.setenv("HUDDLE_TOKEN_OF_A_TEST", token)
    access = Access(web, b"key", ended)
    assert not access.is_open
    assert access.by_token("192.0.2.1", token) is not None
    assert access.by_token("192.0.2.1", token[1:]) is None
    monkeypatch.setenv("HUDDLE_TOKEN_OF_A_TEST", token[1:])
    with pytest.raises(AccessError, match="expected a token of at least"):
        Access(web, b"key", ended)


def test_visits_last_over_a_restart_and_end_with_a_log_out_or_the_secret(tmp_path: Path) -> None:
    bench = bench_file(tmp_path, SECRETS)
    with serving(bench) as first:
        visit, left = first.visit(READER), first.visit(READER)
        (token,) = set(re.findall(r'name="token" value="(\w+)"', left.get("/tests").text))
        assert left.post("/logout", {"token": token}).status == 303
        assert left.get("/tests").status == 303  # the same cookie
        assert visit.get("/tests").status == 200
        port = int(first.url.rsplit(":", 1)[1].strip("/"))
    with serving(bench, port=port):
        assert left.get("/tests").status == 303
        assert visit.get("/tests").status == 200
    bench.write_text(re.sub(r"sha256:\w{64}", "sha256:" + 64 * "0", bench.read_text()))
    with serving(bench, port=port):
        assert visit.get("/tests").status == 303


def test_a_form_may_not_be_large(closed: Server) -> None:
    assert closed.visit().post("/login", {"name": "x" * 100_000}).status == 413


def test_the_login_leads_to_these_pages_only(closed: Server) -> None:
    for after in ("https://evil.example/", "//evil.example", "/\\evil.example"):
        form = {"name": "Ada", "secret": READER, "next": after}
        assert closed.visit().post("/login", form).headers["location"] == "/"


@pytest.mark.long
def test_a_service_keeps_its_pages_running(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    bench = bench_file(tmp_path, SERVICE.format(port=port))
    visit = Visit(f"http://127.0.0.1:{port}")

    def answers() -> bool:
        try:
            return visit.get("/tests").status == 200
        except OSError:
            return False

    with (tmp_path / "log").open("wb") as log:
        service = subprocess.Popen(
            [sys.executable, "-m", "tui", "serve", str(bench)], stderr=log, stdout=log
        )
    try:
        wait_until(answers, "the pages of the service")
        assert "service    running, bench cellar" in visit.get("/").text
        children = Path(f"/proc/{service.pid}/task/{service.pid}/children").read_text().split()
        (pages,) = (pid for pid in children if b"web" in Path(f"/proc/{pid}/cmdline").read_bytes())
        os.kill(int(pages), signal.SIGKILL)
        wait_until(lambda: not answers(), "the pages have ended")
        wait_until(answers, "the pages are served again")
    finally:
        service.terminate()
        service.wait(limit(60))
    assert not answers()


def test_curves_and_words_of_a_test_are_as_kept() -> None:
    """Beside another one with a limit that is not decided, at two choices of what is drawn."""
    result = Result(diagnosed(n_effective=100.0), SETTINGS, bench_with(12e-12))
    other = Result(made_snapshot(), SETTINGS, recordings=(Path("other.h5"),))
    state = compared(State("bench", result=result), State("other", result=other))
    lines = [
        line
        for asked in (dict[str, str](), {"channel": "4", "unit": "1", "from": "2", "to": "20"})
        for line in picture(state, choice_of(state, asked)).splitlines()
    ]
    about = about_test(state, {"segment": 2.0})
    section = Section(
        "", tuple(each for each in about.values() if isinstance(each, (Table, Items)))
    )
    words = (
        f"{name}: {each}" for name, each in about.items() if isinstance(each, (str, tuple, list))
    )
    kept = Path(__file__).parent / "curves.txt"
    assert_as_kept([*lines, *words, *lines_of([section])], kept)
