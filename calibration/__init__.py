"""Convert the raw frames of a session to a look-up table (LUT)."""
