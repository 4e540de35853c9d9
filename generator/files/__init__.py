"""Encoders of 16-bit linear images, one file a format; `generator.files.formats` is their door."""
