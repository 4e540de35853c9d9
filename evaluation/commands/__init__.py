"""The commands of `evaluate`, one module for each."""
