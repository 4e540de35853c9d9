"""The look-up table on disk and in a store."""
