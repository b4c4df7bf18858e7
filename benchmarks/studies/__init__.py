"""Studies of minutes to hours whose tables stand in ``docs/validation``: ``make studies``.

``python -m benchmarks.studies`` carries out those beside theory or truth, as ``huddle reproduce``
does the paper's; `levels` and `leaning` print tables of their own.
"""
