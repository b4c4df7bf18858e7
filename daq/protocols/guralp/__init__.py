"""Güralp: GCF blocks, their streams, and the BRP and Scream links that transport them."""
