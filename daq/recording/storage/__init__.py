"""How a recording lies on the disk: superblock, locks, and how its file is opened."""
