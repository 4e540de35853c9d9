"""Live page of `acquire monitor`, and the report of a session."""
