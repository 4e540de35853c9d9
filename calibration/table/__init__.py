"""The look-up table (LUT) on disk and in a store."""
