"""A form for a certificate of a test that has ended, or for a specimen of one."""

from __future__ import annotations

from collections.abc import Mapping

from tui.application.forms.form import Field, Form

HINTS = {
    "by": "Who authorises the certificate. Empty: a specimen, watermarked and without a number.",
    "reason": "Why a certificate of the same recording is revised. Empty for the first one.",
    "despite": "Why a result that a fact invalidates is certified; printed on page 1.",
}


class IssueForm(Form[Mapping[str, str]]):
    """Asks who authorises a certificate; returns the values, None if it was left.

    Parameters
    ----------
    name : str
        Of the recording.
    kept : mapping of str to str
        What was given before, by field.
    """

    HINTS = HINTS

    def __init__(self, name: str, kept: Mapping[str, str]) -> None:
        fields = [
            Field("by", "authorised by", kept.get("by", ""), "empty: a specimen"),
            Field("reason", "reason of a revision", kept.get("reason", "")),
            Field("despite", "despite", kept.get("despite", "")),
        ]
        super().__init__(f"certificate of {name}", fields, does="makes it")

    def submit(self) -> None:
        """Return what was given."""
        self.dismiss({name: self.value(name) for name in HINTS})
