"""What is measured of one frame, and kept of it: nothing here depends on another frame."""
