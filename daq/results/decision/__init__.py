"""The decision on the limits of a bench: pass, fail or not decided, and the time to a decision.

Computes from a finished estimate and the masks of the bench file. No sentences: these are in
`tui.output`.
"""
