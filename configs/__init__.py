"""Settings: dataclasses with defaults, documentation and ranges, and presets as YAML files."""
