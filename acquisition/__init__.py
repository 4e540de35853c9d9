"""The experiment's design and its execution: chart, lights, plan, and the session that is taken."""
