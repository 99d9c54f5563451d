"""Processing of a whole recording into a run folder."""
