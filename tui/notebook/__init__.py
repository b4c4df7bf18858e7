"""The implementation of ``import huddle``: estimates, recordings and simulations for scripts.

Results have labelled axes, tables and figures. No command line, no terminal, no numerics.
"""
