"""What follows from an estimate: band values, limits, the effect of the clocks.

Numbers only; sentences are made in `tui.output`.
"""
