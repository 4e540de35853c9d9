"""Data sets: planning, generating, storing and reading."""
