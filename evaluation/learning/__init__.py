"""Methods that learn from scenes with known lights, one file a method."""
