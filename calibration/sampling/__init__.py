"""From photosites to the samples of a cell."""
