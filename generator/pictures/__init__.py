"""Source pictures: find and read files, convert them to sRGB codes, or make random ones."""
