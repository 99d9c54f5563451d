"""The state of a run in one SQLite database: checkpoints while it goes on, and what continues it from them."""
