"""LabJack T7 and T8: stream packets and registers."""
