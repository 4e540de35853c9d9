"""What lens and projector do to the light beside a Gaussian blur: shoulders, veil, lateral colour, fall-off."""
