"""Recordings and cameras in, files for other programs out."""
