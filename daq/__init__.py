"""Wires to files and back: acquisition, recordings, alignment and estimates of them.

No terminal, no simulator. Packages import only those below them; see docs/architecture.md.
"""
