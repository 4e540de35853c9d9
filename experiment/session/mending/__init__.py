"""What of a session is to be taken again: damaged files, lights that are named, and what a table could not use."""
