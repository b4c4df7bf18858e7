"""SeedLink 3 and 4: packets, miniSEED records, and the streams of sensors."""
