"""Settings and their YAML files."""
