"""Source pictures: found, read, converted to sRGB codes; and the tone mapping that makes raw images visible."""
