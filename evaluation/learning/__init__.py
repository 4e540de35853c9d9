"""Methods that learn from scenes with ground truth, one file per method."""
