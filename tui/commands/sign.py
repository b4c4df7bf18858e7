"""``huddle sign``: signatures of recordings, and keys."""

from __future__ import annotations

from typing import TYPE_CHECKING

import typer

from daq.errors import RecordingError
from daq.recording.repair import verify
from daq.recording.signing import make_key, sign
from tui.output.console import for_people

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path


def sign_recordings(recordings: Sequence[Path], *, key: Path | None, new_key: Path | None) -> None:
    """Sign closed recordings that are intact, or make a key.

    Raises
    ------
    RecordingError
        If one is damaged; those before it are signed.
    SigningError
        If a key or signature cannot be read or written.
    """
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
