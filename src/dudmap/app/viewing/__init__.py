"""What a run looks like: the report of a run folder, the page in the browser while it runs, the log for Rerun."""
