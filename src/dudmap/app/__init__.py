"""A run: its processing into a run folder, its stored state, and its views for people."""
