"""Facts, findings and verdicts as words. Chosen by type; never parsed.

Tables of numbers are in `tui.output`.
"""
