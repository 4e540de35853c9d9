"""From counts to linear light: dark frames, primaries, drift, linearity and noise."""
