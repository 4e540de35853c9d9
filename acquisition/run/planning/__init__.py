"""What a run will take, need and find: a value made before anything moves, printed by a dry run, required by a run."""
