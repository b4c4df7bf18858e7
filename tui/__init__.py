"""Terminal front ends: the `huddle` command, the Textual application, reports, studies.

No numerics of its own: numbers come from `daq.results` and `estimator`.
"""

__version__ = "0.1.0"
