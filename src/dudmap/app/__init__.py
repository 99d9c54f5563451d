"""A run: frames in, a run folder out, its state, and what a person sees of it."""
