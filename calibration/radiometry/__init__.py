"""From counts to linear light: paper, field, dark light, primaries, reference greys, noise."""
