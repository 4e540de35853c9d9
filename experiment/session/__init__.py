"""A session on disk: its plan, its journal, its folder, and how far it has come."""
