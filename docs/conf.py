"""Builds the documentation with Sphinx: ``make docs``.

Pages are Markdown; the API reference comes from the docstrings. Examples run when their page is
built: the directive ``example`` shows a script of ``examples/``, what it prints, and the figures
that it writes.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from importlib.metadata import version as installed
from pathlib import Path
from shutil import copyfile
from typing import TYPE_CHECKING, ClassVar

from docutils import nodes
from sphinx.util.docutils import SphinxDirective

if TYPE_CHECKING:
    from sphinx.application import Sphinx

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

        make = {
            "commands": reference.commands,
            "bench_file": reference.bench_file,
            "troubleshooting": reference.troubleshooting,
            "facts": reference.facts,
            "findings": reference.findings,
            "result": reference.result,
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
        kept = ROOT / "docs" / FIGURES / f"{stem}-{path.name}"
        kept.parent.mkdir(exist_ok=True)
        copyfile(path, kept)
        return nodes.image(uri=f"/{FIGURES}/{kept.name}", alt=f"Figure written by {stem}.py")


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directives."""
    app.add_directive("example", Example)
    app.add_directive("reference", Reference)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
