"""Find the chart in a frame: homography, tags, outline, sharpness and movement."""
