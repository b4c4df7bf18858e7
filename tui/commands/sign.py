"""``huddle sign``: signatures of recordings."""

# ruff: noqa: PLC0415 - what the command needs is imported when it runs

from __future__ import annotations

from pathlib import Path

import typer

from daq.errors import RecordingError
from tui.commands.options import command
from tui.output.console import for_people


@command()
def sign(
    recordings: list[Path] | None = None,
    *,
    key: Path | None = None,
    new_key: Path | None = None,
) -> None:
    """Sign recordings with a private key, or make one.

    A recording is verified before. Its signature is a file beside it (.sig).

    Parameters
    ----------
    recordings : RECORDING
        Closed recordings.
    key : FILE
        Private key (ed25519, PEM).
    new_key : FILE
        Make a key, and FILE.pub for others.

    Examples
    --------
    huddle sign --new-key ~/lab.key
    huddle sign lab.h5 --key ~/lab.key
    """
    from daq.recording.repair import verify
    from daq.recording.signing import make_key, sign

    recordings = recordings or []
    screen = for_people(None)
    if new_key is not None:
        public = make_key(new_key)
        screen.print(f"{new_key}: private key; keep it from those who can write recordings")
        screen.print(f"{public}: public key, for huddle verify --key")
    if recordings and key is None and new_key is None:
        raise typer.BadParameter("no key; expected --key FILE")
    if not recordings and new_key is None:
        raise typer.BadParameter("nothing to sign; expected recordings, or --new-key FILE")
    for path in recordings:
        if not verify(path).intact:
            raise RecordingError(f"{path}: damaged, and not signed; see huddle verify {path}")
        signature = sign(path, key or new_key or path)
        screen.print(f"{path}: signed with key {signature.key_id}", soft_wrap=True)
