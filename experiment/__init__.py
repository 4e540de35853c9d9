"""The experiment as data: chart, lights, settings, the session on disk, and what counts of a frame say of the print."""
