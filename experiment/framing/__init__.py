"""Find the chart in a frame, and measure its pose, sharpness and movement."""
