"""Device protocols, sans-IO: bytes in, blocks out.

No asyncio, no sockets, no clock, no files. Simulated devices share these modules.
"""
