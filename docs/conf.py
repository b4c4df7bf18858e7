"""Builds the documentation with Sphinx: ``make docs``.

Pages are Markdown; the API reference comes from the docstrings. The directive ``example`` runs a
script of ``examples/`` and shows what it prints and draws, ``gallery`` runs commands and shows
their pictures, ``reference`` makes tables of what the program declares.
"""

from __future__ import annotations

import asyncio
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from importlib.metadata import version as installed
from pathlib import Path
from typing import ClassVar

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

ROOT = Path(__file__).resolve().parents[1]
FIGURES = "_figures"
"""Folder of the figures beside the pages; not in version control."""

project = "huddle"
author = "the huddle project"
release = version = installed("huddle-bench")
extensions = ["myst_parser", "sphinx.ext.autodoc", "numpydoc"]
exclude_patterns = ["images/**", FIGURES]
html_theme = "pydata_sphinx_theme"
html_theme_options = {"secondary_sidebar_items": ["page-toc"], "show_prev_next": False}
html_show_copyright = False
html_show_sourcelink = False
html_extra_path = [
    "../tui/resources/result-2.schema.json",
    "../tui/resources/archive-2.schema.json",
    "../tui/resources/archive-stations-1.schema.json",
    "../tui/resources/calibration-1.schema.json",
    "../tui/resources/status-1.schema.json",
]

default_role = "py:obj"

myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 3

autodoc_member_order = "bysource"
autodoc_typehints = "none"  # numpydoc's own sections have them
numpydoc_show_class_members = False
numpydoc_class_members_toctree = False


class Reference(SphinxDirective):
    """A reference made of what the program declares: see `docs.reference`."""

    required_arguments = 1
    option_spec: ClassVar[dict[str, object]] = {}

    def run(self) -> list[nodes.Node]:
        """Make the Markdown, and the page of it."""
        sys.path.insert(0, str(ROOT))
        from docs import reference  # noqa: PLC0415 - needs the root on the path

        make: dict[str, Callable[[], str]] = {
            "commands": reference.commands,
            "bench_file": reference.bench_file,
            "troubleshooting": reference.troubleshooting,
            "facts": reference.facts,
            "findings": reference.findings,
            "packages": reference.packages,
            "result": partial(reference.keys, "result-2.schema.json"),
            "calibration": partial(reference.keys, "calibration-1.schema.json"),
            "status": partial(reference.keys, "status-1.schema.json"),
            **{name: partial(reference.values, name) for name in reference.VALUES},
        }
        found: list[nodes.Node] = self.parse_text_to_nodes(
            make[self.arguments[0]](), allow_section_headings=True
        )
        return found


class Example(SphinxDirective):
    """Shows a script of ``examples/``, its output and its figures."""

    required_arguments = 1
    option_spec: ClassVar[dict[str, object]] = {}

    def run(self) -> list[nodes.Node]:
        """Run the script in a folder of its own."""
        script = ROOT / "examples" / self.arguments[0]
        self.env.note_dependency(str(script))
        with tempfile.TemporaryDirectory() as folder:
            done = subprocess.run(
                [sys.executable, "-P", str(script)],
                cwd=folder,
                env=os.environ | {"MPLBACKEND": "agg", "COLUMNS": "100"},
                capture_output=True,
                text=True,
                check=False,
            )
            if done.returncode:
                raise self.severe(f"{script} failed:\n{done.stderr}")
            figures = [self._figure(path, script.stem) for path in Path(folder).glob("*.svg")]
        source = script.read_text(encoding="utf-8")
        return [
            nodes.literal_block(source, source, language="python"),
            nodes.paragraph(text="It prints:"),
            nodes.literal_block(done.stdout, done.stdout, language="text"),
            *figures,
        ]

    def _figure(self, path: Path, stem: str) -> nodes.image:
        return kept_image(path, f"{stem}-{path.name}", f"Figure written by {stem}.py")


class Gallery(SphinxDirective):
    """Runs commands of huddle, and shows the pictures that they write.

    All commands of a page share a folder. A line ``huddle tui FILE  # KEYS`` is a picture of the
    application after these keys, one ``huddle report … --out NAME.pdf`` of the first page.
    """

    has_content = True
    option_spec: ClassVar[dict[str, object]] = {}

    def run(self) -> list[nodes.Node]:
        """Run the commands, each in its turn."""
        made = self.env.temp_data.setdefault("gallery", tempfile.TemporaryDirectory())
        folder = Path(made.name)
        lines = list(self.content)
        found: list[nodes.Node] = [nodes.literal_block("", "\n".join(lines), language="sh")]
        for line in lines:
            before = set(folder.iterdir())
            picture(line, folder)
            for path in sorted(set(folder.iterdir()) - before):
                if path.suffix in {".png", ".svg"}:
                    name = f"gallery-{path.name}"
                    found.append(kept_image(path, name, f"Made by: {line}"))
        return found


def picture(line: str, folder: Path) -> None:
    """Run a line of the gallery in a folder; raises RuntimeError if it fails."""
    sys.path.insert(0, str(ROOT))
    from docs.images.terminal import photograph  # noqa: PLC0415 - needs the root on the path

    words = shlex.split(line, comments=True)
    if words[1] == "tui":
        keys = tuple(line.partition("#")[2].split())
        drawn = asyncio.run(photograph(folder / words[2], size=(100, 30), keys=keys))
        (folder / f"application-{'-'.join(keys)}.svg").write_text(drawn, encoding="utf-8")
        return
    command = [sys.executable, "-P", "-m", "tui", *words[1:]]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode not in {0, 1, 4}:  # 1 and 4 are verdicts
        raise RuntimeError(f"{line}: exit code {done.returncode}\n{done.stderr}")
    if words[-1].endswith(".pdf") and shutil.which("pdftoppm"):  # of poppler-utils
        page = ["pdftoppm", "-singlefile", "-r", "60", "-png", words[-1], words[-1][:-4]]
        subprocess.run(page, cwd=folder, check=True)


def kept_image(path: Path, name: str, alt: str) -> nodes.image:
    """Keep a picture beside the pages, where Sphinx finds it."""
    kept = ROOT / "docs" / FIGURES / name
    kept.parent.mkdir(exist_ok=True)
    shutil.copyfile(path, kept)
    return nodes.image(uri=f"/{FIGURES}/{name}", alt=alt)


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directives."""
    app.add_directive("example", Example)
    app.add_directive("gallery", Gallery)
    app.add_directive("reference", Reference)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
