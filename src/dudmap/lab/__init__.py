"""What measures the system: synthetic recordings, benchmarks and designed studies."""
