"""Run folders, checkpoints, loggers, and what lists and compares runs."""
