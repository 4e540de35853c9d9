"""From the frames of a session to a table, step by step."""
