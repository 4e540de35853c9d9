"""Source pictures: found, read, converted to sRGB codes, and shown to the eye."""
