"""Suites of recordings, measured with named systems: one table, a gate against regressions, the limit of dynamics."""
