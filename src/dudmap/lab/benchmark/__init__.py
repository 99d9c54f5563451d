"""Benchmarks: suites of recordings, the accuracy gate, the limit of dynamics, and speed."""
