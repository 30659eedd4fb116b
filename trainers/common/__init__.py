"""What all trainers share: optimization, distribution, sampling, state."""
