"""A table in the browser: its lights as points, a picture under any of them, and the command that makes the same."""
