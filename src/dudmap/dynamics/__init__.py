"""Which pixels of a registered frame move."""
