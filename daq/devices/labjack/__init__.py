"""LabJack T7 and T8."""
