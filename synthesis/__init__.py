"""Compute look-up tables (LUTs) from spectra and a model of the sensor, without a laboratory."""
