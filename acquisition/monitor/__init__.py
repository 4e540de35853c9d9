"""Live web page of a session (`acquire monitor`), and the report of a session."""
