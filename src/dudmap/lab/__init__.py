"""Measurement of the system: synthetic recordings, benchmarks and designed studies."""
