"""Encoders of 16-bit linear images, one file a format; `generator.encode` is their door."""
