"""The command `generate`: its options, and what it shows meanwhile."""
