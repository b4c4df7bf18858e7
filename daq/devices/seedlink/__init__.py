"""SeedLink 3 and 4: packets, miniSEED records, streams of sensors."""
