"""The stages from the frames of a session to a LUT."""
