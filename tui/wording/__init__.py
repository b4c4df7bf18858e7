"""Advice as words: whole sentences, several pieces in one line, a few words for a screen.

Chosen by the type of the advice; never parsed. Tables of numbers are in `tui.output`.
"""

from tui.wording import differences as differences  # registers its sentences
from tui.wording import misfit as misfit  # likewise
