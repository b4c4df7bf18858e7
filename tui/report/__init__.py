"""The calibration report: everything about one huddle test on paper or in a page to be kept.

Import it when it is wanted: it loads matplotlib.
"""

from tui.report.writing import ReportError, write

__all__ = ["ReportError", "write"]
