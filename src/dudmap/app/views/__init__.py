"""Images of the map: artificial views, videos, and recordings without what moves."""
