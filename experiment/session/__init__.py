"""A session on disk: plan, journal, folder, and progress."""
