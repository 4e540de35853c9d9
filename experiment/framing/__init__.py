"""Where the chart is in a frame: planes of the mosaic, homography, AprilTags, outline, sharpness, movement."""
