"""Registration: the position of every patch in a frame, and movements in later frames."""
