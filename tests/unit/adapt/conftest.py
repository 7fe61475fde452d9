from command_runner import here, run, shown  # noqa: F401  fixtures
