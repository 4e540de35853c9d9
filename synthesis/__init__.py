"""Synthesis: a table without a laboratory, computed from spectra and a model of the sensor."""
