"""Acquisition of a session: the laboratory is checked, and frames are planned, taken, judged and shown."""
