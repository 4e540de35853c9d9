"""Live judge: each frame of a session is judged as it is taken, by its light, chart and exposure."""
