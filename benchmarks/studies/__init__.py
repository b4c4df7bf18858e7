"""Studies of minutes to hours whose tables stand in ``docs/validation``: ``make studies``."""
