"""Moving objects with identity, velocity and, where they are rigid, a map of their own."""
