"""Images of the map: artificial views, videos, and recordings without dynamic objects."""
