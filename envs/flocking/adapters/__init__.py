"""The flocking environment for Gymnasium and PettingZoo."""
