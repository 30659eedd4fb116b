"""The models by name: configurations of ModGNN's submodules."""
