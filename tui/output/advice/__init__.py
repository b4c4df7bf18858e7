"""Advice as words: whole sentences, several pieces in one line, a few words for a screen.

Chosen by the type of the advice; never parsed.
"""

from tui.output.advice import misfit as misfit  # registers its sentences
