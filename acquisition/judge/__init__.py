"""Judge each frame as it is taken: light, chart and exposure."""
