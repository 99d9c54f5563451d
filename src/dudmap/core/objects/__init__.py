"""Moving objects with identity and velocity; rigid objects also have a map."""
