"""The command line: configuration, help, error messages and completion."""
