"""The physics renderer."""
