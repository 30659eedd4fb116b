"""Replays, images and videos of rollouts."""
