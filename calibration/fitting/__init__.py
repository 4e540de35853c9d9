"""Least squares and the polynomial bases that calibration fits with; knows neither frames nor charts."""
