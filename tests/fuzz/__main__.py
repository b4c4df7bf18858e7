"""``python -m tests.fuzz TARGET SECONDS CORPUS_FOLDER``: a coverage-guided run (needs atheris)."""

from __future__ import annotations

import sys
from pathlib import Path

import atheris  # type: ignore[import-untyped]  # no dependency: runs where it is installed

with atheris.instrument_imports(include=["daq.protocols", "daq.devices"]):
    from tests.fuzz.targets import TARGETS


def main(name: str, seconds: str, folder: str) -> None:
    """Fuzz one target; atheris ends the program itself."""
    target, seeds = TARGETS[name]
    corpus = Path(folder) / name
    corpus.mkdir(parents=True, exist_ok=True)
    for k, seed in enumerate(seeds):
        (corpus / f"seed-{k}").write_bytes(seed)
    options = [f"-max_total_time={seconds}", "-max_len=4096", "-timeout=10", "-rss_limit_mb=8000"]
    options += ["-print_final_stats=1", f"-artifact_prefix={folder}/{name}-"]
    atheris.Setup([sys.argv[0], str(corpus), *options], target)
    atheris.Fuzz()


if __name__ == "__main__":
    main(*sys.argv[1:])
