"""What is asked of a frame: each check with its number, its limits, and what a person is told where it fails."""
