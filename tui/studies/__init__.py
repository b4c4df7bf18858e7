"""The paper's figures reproduced: simulated, estimated, judged by theory.

Studies of what the paper does not contain are in `benchmarks.studies`, outside the wheel.
"""
