"""A session on disk: its plan, its journal, its folder, and the state of its run."""
