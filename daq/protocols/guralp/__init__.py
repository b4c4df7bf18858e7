"""Güralp: GCF blocks, their streams, and the BRP and Scream links that carry them."""
