"""Store the state of a run in one SQLite database, at checkpoints, and continue the run from it."""
