"""The experiment's execution: the lab is checked, a session is planned, taken, judged and watched."""
