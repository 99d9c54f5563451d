"""What a run looks like: the report of a run folder and the page in the browser while it runs."""
