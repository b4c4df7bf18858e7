"""The documents: numbered decisions, links that resolve, and commands that exist."""

from __future__ import annotations

import re
from itertools import chain
from pathlib import Path

import pytest

from daq.bench.model import Bench
from daq.results.facts.fact import Finding
from docs.reference import VALUES, bench_file, commands, facts, findings, values
from estimator.checks.advice import Rank
from tests.tui.wording.advice_examples import EXAMPLES as ADVICE
from tests.tui.wording.advice_examples import names
from tests.tui.wording.fact_examples import EXAMPLES as FACTS
from tui.commands.help import COMMANDS, subcommand
from tui.output.json_document import facts_document

ROOT = Path(__file__).parents[1]
DECISIONS = sorted((ROOT / "docs" / "decisions").glob("[0-9]*.md"))
PAGES = sorted(
    page
    for page in chain(ROOT.glob("*.md"), ROOT.glob("docs/**/*.md"), ROOT.glob("examples/**/*.md"))
    if page.name[0] != "_"
)
SOURCES = ("daq", "estimator", "sim_devices", "tui", "examples")


def name(page: Path) -> str:
    """Return the path of a page from the root of the repository."""
    return str(page.relative_to(ROOT))


def test_decisions_are_numbered_without_holes() -> None:
    assert [int(page.name[:4]) for page in DECISIONS] == list(range(1, len(DECISIONS) + 1))


@pytest.mark.parametrize("page", DECISIONS, ids=name)
def test_a_decision_has_status_date_and_sections(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert text.startswith(f"# {page.name[:4]}. ")
    status = re.match(
        r"(Accepted|Superseded by \S+|Proposed) \d{4}-\d\d-\d\d", text.splitlines()[2]
    )
    assert status is not None
    sections = re.findall(r"^## (.*)$", text, re.MULTILINE)
    if status[1].startswith("Superseded"):  # a line is left of it
        assert (len(text.splitlines()), sections) == (5, [])
    else:
        assert sections == ["Context", "Decision", "Consequences"]
    assert len(text.splitlines()) <= 45
    index = (page.parent / "index.md").read_text(encoding="utf-8")
    assert f"[{page.name[:4]}]({page.name})" in index


def test_links_resolve() -> None:
    missing = []
    for page in PAGES:
        text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
        for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", text):
            local = "://" not in target and not target.startswith("mailto")
            if local and not (page.parent / target).exists():
                missing.append(f"{name(page)}: {target}")
    assert missing == []


def test_files_and_names_that_contributors_read_of_exist() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    paths = re.findall(r"`([a-z_./]+/[\w./-]*)`", text.replace("NAME.py", ""))
    assert len(paths) > 25
    assert [each for each in paths if not (ROOT / each).exists()] == []
    named = re.findall(r"`(\w+)` in `([\w/]+\.(?:py|toml|md))`", text)
    assert len(named) > 5
    assert [
        (word, path)
        for word, path in named
        if not re.search(rf"\b{word}\b", (ROOT / path).read_text(encoding="utf-8"))
    ] == []


def test_documents_that_code_names_exist() -> None:
    missing = []
    for source in chain.from_iterable((ROOT / folder).rglob("*.py") for folder in SOURCES):
        if source == Path(__file__):
            continue
        for found in re.findall(r"docs/[\w/.-]+", source.read_text(encoding="utf-8")):
            path = ROOT / found.rstrip(".")
            if not path.exists() and not list(path.parent.glob(f"{path.name}*")):
                missing.append(f"{name(source)}: {found}")
    assert missing == []


def test_commands_and_their_options_exist() -> None:
    texts = {name(page): page.read_text(encoding="utf-8") for page in PAGES}
    lines = [
        (where, line)
        for where, text in texts.items()
        for line in re.findall(r"(?:^|[`\s/\\])huddle ([a-z]+[^`\n]*)", text, re.MULTILINE)
    ]
    wrong = []
    for where, line in lines:
        word = line.split()[0]
        options = re.findall(r"(?<!\S)--[a-z][a-z-]*", line)
        if word not in COMMANDS:
            if options or re.search(rf"`huddle {word}`", texts[where]):
                wrong.append(f"{where}: huddle {line}")
            continue
        known = {
            "--help",
            "--help-all",
            *chain.from_iterable(p.opts + p.secondary_opts for p in subcommand(word).params),
        }
        wrong += [f"{where}: huddle {word} {option}" for option in options if option not in known]
    assert wrong == []


def test_the_reference_of_the_bench_file_explains_every_key() -> None:
    text = bench_file()
    keys = re.findall(r"^\| `(\w+)` \|.*\| (.*?) \|$", text, re.MULTILINE)
    plain = {"name", "address", "email", "phone", "operator", "location", "model", "manufacturer"}
    unexplained = {key for key, why in keys if not why.strip()} - plain
    assert unexplained <= {"serial_number", "date"}
    assert {*Bench.model_fields} - {"sensors", "estimate", "recording", "schedule"} <= {
        *(key for key, _ in keys),
        *re.findall(r"^## `\[+(\w+)\]+`", text, re.MULTILINE),
    }
    for table in ("[[sensors.channels]]", "[estimate]", "[[limits]]", "[[schedule]]", "[storage]"):
        assert f"## `{table}`" in text
    assert "| `segment` |" in text
    assert re.search(r"^\| `keep_for` \| duration", text, re.MULTILINE)


def test_the_reference_of_commands_has_every_command_and_option() -> None:
    text = commands()
    assert "\x1b" not in text
    for name in COMMANDS:
        section = text.partition(f"### huddle {name}\n")[2].partition("\n### ")[0]
        for parameter in subcommand(name).params:
            flags = [flag for flag in parameter.opts if flag.startswith("--")]
            assert getattr(parameter, "hidden", False) or all(flag in section for flag in flags)


def test_the_reference_of_facts_has_every_kind_and_number_of_the_json() -> None:
    who = names("A", "B", "C")
    advice = [Finding(rank=Rank.DELAYS, findings=(each,), names=who) for each in ADVICE]
    written = facts_document([*FACTS, *advice])
    for table, found in (
        (facts(), written),
        (findings(), [each for fact in written for each in fact["numbers"].get("findings", ())]),
    ):
        for each in found:
            row = table.partition(f"\n| `{each['kind']}` |")[2].partition("\n")[0]
            assert all(f"`{key}`" in row for key in each["numbers"]), each["kind"]
            assert len(row.split(" | ")[0]) > 15


@pytest.mark.parametrize("name", VALUES)
def test_each_value_of_a_kind_is_explained(name: str) -> None:
    rows = re.findall(r"^\| `([\w-]+)` \| \w[^|]+\.? \|$", values(name), re.MULTILINE)
    assert rows == list(VALUES[name])


def test_twenty_questions_are_answered_by_pages() -> None:
    text = (ROOT / "docs" / "questions.md").read_text(encoding="utf-8")
    questions = re.findall(r"^(\d+)\. \*\*.*\?\*\* (.*)$", text, re.MULTILINE)
    assert [int(number) for number, _ in questions] == list(range(1, 21))
    assert all("](" in answer for _, answer in questions)
    index = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    assert "[Questions](questions.md)" in index


def test_the_site_has_five_shelves_and_folds_the_evidence() -> None:
    index = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    shelves = dict(re.findall(r":caption: ([^\n]*)\n\n(.*?)\n```", index, re.DOTALL))
    assert list(shelves) == ["Start", "How-to", "Reference", "Understand", "Evidence"]
    assert shelves["Evidence"].split() == ["validation/index", "decisions/index"]
    assert index.count("{toctree}") == len(shelves)
