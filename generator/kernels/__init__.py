"""From codes to samples: what is compiled, and the arithmetic it rests on."""
