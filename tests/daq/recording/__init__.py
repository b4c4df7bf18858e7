"""The recording: format, crash safety, healing."""
