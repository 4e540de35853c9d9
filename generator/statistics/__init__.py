"""Statistics of images and lights: what one image gives, and the file in which those of a real data set are kept."""
