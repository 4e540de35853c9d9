"""The report on the measurement of a look-up table (LUT)."""
