"""What is known of a session so far, that a frame is held against: places, light, the projector."""
