"""Mark and suffix of a saved session, read without what writes one."""

SESSION_MARK = b"nlos-cam session"
"""In the head of the file."""
SESSION_SUFFIX = ".html"
