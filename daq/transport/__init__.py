"""Serial ports, TCP and UDP as byte streams with the host time of each read.

Knows no protocol and no bench file.
"""
