"""Look-up tables computed from spectra and a model of the sensor, without a laboratory."""
