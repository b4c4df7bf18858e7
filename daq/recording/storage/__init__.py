"""The file of a recording: superblock, locks, journal, names, and safe opening."""
