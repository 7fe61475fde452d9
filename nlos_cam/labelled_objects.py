"""The objects that a label alone tells: the test objects, by name."""
