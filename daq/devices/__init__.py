"""One folder a family of devices: its protocol (bytes to blocks, no I/O), driver and settings.

Modules here are what families have in common. Drivers are found through the entry points
``huddle.drivers``.
"""
