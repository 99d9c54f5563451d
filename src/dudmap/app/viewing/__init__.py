"""Views of a run: the report of a run folder, the live page in the browser, the log for Rerun."""
