"""Recorder processes: started, found, stopped; Ctrl-C deferred."""
