"""Projectors with a line protocol of their maker, on a serial cable or over TCP."""
