"""Hidden objects."""
