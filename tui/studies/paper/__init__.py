"""Studies of the paper itself: its numerical examples and its laboratory set-ups.

What the paper does not contain stands beside this package.
"""
