"""Small helpers that know nothing of policies or environments: tensors, seeds, files, progress, signals."""
