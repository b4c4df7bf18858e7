"""The Signal view: a recording against time."""
